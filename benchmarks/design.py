"""Designs by deformed layers: speed, variety and fidelity, beside graph cut.

Sections: `table2` and `variants`; `sheets` draws contact sheets.

`table2` lays deformed layers over 360 x 360 pixels and completes the holes, for patches of 32, 64
and 92 pixels, with the exhaustive search, by Fourier transforms and by quadtree pyramids, as in
table 2 of Shen et al. 2010. `energy` is the mean squared difference per known pixel of the patches
that were found; `search` is the CPU time of the searches alone.

`variants` makes ten designs and ten graph cuts of each exemplar, or `--count` of them. `swd` is
the mean distance of some pairs; `offsets` the mean difference, in pixels, of where two of them take
a pixel from; `bend` that of the directions in which the sources of neighbours lie, which is 0
between copies that are only moved; `nn` (of the middle 128 x 128 pixels of two) and `swd_exemplar`
(of one) compare with the exemplar, `nn_turned` with it and its quarter turns; `sharp` is the mean
step inside completed pixels over that of the exemplar.
"""

import argparse
import json
import statistics
import time
from itertools import combinations
from pathlib import Path

import torch
from common import add_arguments, environment, measured, once, photos_of
from exemplars import crop
from PIL import Image, ImageDraw, ImageFont

from torchtex import data, metrics
from torchtex.layers.deform import Spread
from torchtex.layers.segment import segment
from torchtex.recipes import completion
from torchtex.recipes.design import design, designs
from torchtex.recipes.design_parts import Layering
from torchtex.recipes.graphcut import graphcut
from torchtex.recipes.layered import Filling, layered
from torchtex.recipes.mending import Mending

NAMES = (
    "pebbles_mixed", "leaves_green", "flowers_meadow", "strawberries", "olives", "maple_leaves",
    "granite_speckled", "brick_tan",
)  # fmt: skip
SEARCHES = ("exhaustive", "fft", "qtp")
PATCHES = (32, 64, 92)
UPRIGHT = Layering(mending=Mending(turns=False))
SIDE, SIZE, LARGE = 128, (256, 256), (360, 360)


class Clocked:
    """A search that counts its CPU seconds, those of getting ready included."""

    def __init__(self, make):
        self.make, self.seconds = make, 0.0

    def __call__(self, *given):
        begun = time.process_time()
        finder = self.make(*given)
        self.seconds += time.process_time() - begun
        clock = self

        class Finder:
            def places(self):
                return finder.places()

            def __call__(self, *given):
                begun = time.process_time()
                found = finder(*given)
                clock.seconds += time.process_time() - begun
                return found

        return Finder()


def table2(photos):
    """One row for each exemplar, patch and search."""
    rows = []
    plain = completion.finder_of
    for name in list(photos)[:3]:
        exemplar = crop(photos[name], 144)
        parts = [segment(exemplar, 3)]
        for patch in PATCHES:
            for search in SEARCHES:
                clock = completion.finder_of = Clocked(plain)
                try:
                    made, spent = once(
                        layered, exemplar, parts, LARGE, filling=Filling(patch, search=search)
                    )
                finally:
                    completion.finder_of = plain
                row = {"exemplar": name, "patch": patch, "search": search, **spent}
                row |= {"search_cpu": clock.seconds, "energy": made.settings["energy"]}
                rows.append(row | {"pasted": made.settings["pasted"]})
                print({k: round(v, 4) if isinstance(v, float) else v for k, v in rows[-1].items()},
                      flush=True)  # fmt: skip
    found = {}
    for patch in PATCHES:
        ours = {s: [r for r in rows if r["patch"] == patch and r["search"] == s] for s in SEARCHES}
        total = {s: {k: sum(r[k] for r in ours[s]) for k in ("cpu", "search_cpu", "energy")}
                 for s in SEARCHES}  # fmt: skip
        base, count = total["exhaustive"], len(ours["exhaustive"])
        found[patch] = {
            s: {
                "cpu": t["cpu"] / count,
                "faster": base["cpu"] / t["cpu"],
                "search_faster": base["search_cpu"] / t["search_cpu"],
                "energy_ratio": t["energy"] / base["energy"],
            }
            for s, t in total.items()
        }
    return {"summary": found, "rows": rows}


def steps(image, where=None):
    """Mean step between neighbours, of those pairs that lie in a mask."""
    found = []
    for axis in (0, 1):
        step = image.diff(dim=axis + 1).abs().mean(0)
        if where is not None:
            n = where.shape[axis] - 1
            step = step[where.narrow(axis, 0, n) & where.narrow(axis, 1, n)]
        found.append(step.flatten())
    return float(torch.cat(found).mean())


def field_gap(a, b):
    """Mean difference of two source fields: of places, and of directions between neighbours."""
    first, second = (one.field.positions[0, ..., 1:].float() for one in (a, b))
    offsets = float((first - second).norm(dim=-1).mean())
    gaps = []
    for axis in (0, 1):
        one, other = first.diff(dim=axis), second.diff(dim=axis)
        whole = (one.norm(dim=-1) < 2) & (other.norm(dim=-1) < 2)  # not across seams
        gaps.append((one - other).norm(dim=-1)[whole])
    return offsets, float(torch.cat(gaps).mean())


def middle(texture):
    """The 128 x 128 pixels in the middle."""
    top, left = ((n - 128) // 2 for n in texture.shape[1:])
    return texture[:, top : top + 128, left : left + 128].contiguous()


def turned(exemplar):
    """The exemplar and its quarter turns, side by side."""
    return torch.cat([exemplar.rot90(n, (1, 2)) for n in range(4)], 2)


def looks(results, exemplar):
    """Variety of a set, and how near it is to the exemplar."""
    pairs = list(combinations(results, 2))
    some = pairs[:: max(1, len(pairs) // 4)]
    fields = [field_gap(a, b) for a, b in pairs]
    textures = [one.texture for one in results]
    return {
        "swd": statistics.mean(metrics.swd(a.texture, b.texture) for a, b in some),
        "offsets": statistics.mean(f[0] for f in fields),
        "bend": statistics.mean(f[1] for f in fields),
        "diversity": metrics.diversity(textures, exemplar),
        "nn": statistics.mean(metrics.nn(middle(x), exemplar) for x in textures[:2]),
        "nn_turned": statistics.mean(metrics.nn(middle(x), turned(exemplar)) for x in textures[:2]),
        "swd_exemplar": statistics.mean(metrics.swd(x, exemplar) for x in textures[:1]),
    }


def ways(wanted=("graphcut", "design")):
    """What is compared, by name."""
    made = {
        "graphcut": lambda z, seed: graphcut(z, SIZE, seed=seed),
        "design": lambda z, seed: design(z, SIZE, seed=seed),
        "design, upright": lambda z, seed: design(z, SIZE, layering=UPRIGHT, seed=seed),
        "design, layers": lambda z, seed: design(z, SIZE, enlarge="layers", seed=seed),
    }
    return {way: made[way] for way in wanted}


def variants(photos, pictures, each, wanted, count):
    """One row for each exemplar and way; the first pictures are kept for the sheets."""
    rows = []
    for name, photo in photos.items():
        exemplar = crop(photo, SIDE)
        for way, make in ways(wanted).items():
            begun = time.process_time()
            results = [make(exemplar, seed) for seed in range(count)]
            row = {"exemplar": name, "way": way, "cpu": (time.process_time() - begun) / count}
            for number, one in enumerate(results[:5]):
                save(one.texture, pictures / f"{name}-{way.replace(', ', '-')}-{number}.png")
            rows.append(row | looks(results, exemplar) | sharpness(exemplar, way))
            print({k: round(v, 3) if isinstance(v, float) else v for k, v in rows[-1].items()},
                  flush=True)  # fmt: skip
        each({"summary": summed(rows), "rows": rows, "count": count})
    return {"summary": summed(rows), "rows": rows, "count": count}


def summed(rows):
    """Means of every way, and medians of ratios to graphcut on the same exemplar."""
    found = {}
    keys = [key for key, value in rows[0].items() if isinstance(value, float)]
    base = {row["exemplar"]: row for row in rows if row["way"] == "graphcut"}
    for way in dict.fromkeys(row["way"] for row in rows):
        ours = [row for row in rows if row["way"] == way]
        found[way] = {key: statistics.mean(row[key] for row in ours) for key in keys}
        for key in ("swd", "offsets", "nn"):
            ratios = [row[key] / base[row["exemplar"]][key] for row in ours]
            found[way][f"{key}_ratio"] = statistics.median(ratios)
        near = [row["nn"] <= 1.2 * base[row["exemplar"]]["nn"] for row in ours]
        found[way]["nn_within_20%"] = sum(near)
    return found


def sharpness(exemplar, way):
    """Mean step in completed pixels over that of the exemplar, of three deformed textures."""
    if way == "graphcut":
        return {"sharp": 1.0}
    parts, found = [segment(exemplar, 3)], []
    for seed in range(3):
        made = layered(exemplar, parts, seed=seed)
        filled = made.patches >= len(made.settings["plan"])
        found.append(steps(made.texture, filled) / steps(exemplar))
    return {"sharp": statistics.mean(found)}


def save(texture, path):
    """An 8-bit PNG."""
    from torchtex.image import save as write

    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, texture)


def page(rows, heads, margin=8, line=18):
    """Pictures in rows, each with words below it, under heads."""
    font = ImageFont.load_default(size=12)
    pictures = [[(_picture(x), words) for x, words in row] for row in rows]
    width = margin + sum(max(r[i][0].width for r in pictures) + margin for i in range(len(heads)))
    tall = [max(p.height for p, _ in row) + line + margin for row in pictures]
    sheet = Image.new("RGB", (width, margin + line + sum(tall)), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    left = margin
    for column, head in enumerate(heads):
        draw.text((left, margin // 2), head, (20, 20, 20), font)
        top = margin + line
        for row, height in zip(pictures, tall, strict=True):
            picture, words = row[column]
            sheet.paste(picture, (left, top))
            draw.text((left, top + picture.height + 1), words, (110, 110, 110), font)
            top += height
        left += max(row[column][0].width for row in pictures) + margin
    return sheet


def _picture(x):
    if isinstance(x, Path):
        return Image.open(x).convert("RGB")
    levels = (x.expand(3, -1, -1).clamp(0, 1) * 255).round().byte()
    return Image.fromarray(levels.permute(1, 2, 0).numpy())


def bundled(out):
    """The sheet in docs/, of the bundled exemplars alone."""
    rows = []
    spread = Spread(rotate=(-180.0, 180.0), scale=(0.8, 1.25), mirror=0.5)
    for name in ("tissue", "galaxies", "gravel", "bricks"):
        z = data.load(name)
        makers = [
            ("", lambda z=z: graphcut(z, SIZE).texture),
            ("seed 1", lambda z=z: design(z, SIZE, seed=1).texture),
            ("seed 2", lambda z=z: design(z, SIZE, seed=2).texture),
            ("seed 3", lambda z=z: design(z, SIZE, seed=3, enlarge="layers").texture),
            ("seed 4", lambda z=z: design(z, SIZE, seed=4, spread=spread).texture),
        ]
        if name == "bricks":  # which would not be a wall
            makers[-1] = ("seed 4, not turned", lambda z=z: design(z, SIZE, seed=4).texture)
        rows.append([(z, name), *((make(), words) for words, make in makers)])
    heads = ["exemplar", "graphcut", "design", "design", "design --enlarge layers",
             "design --rotate=-180:180"]  # fmt: skip
    page(rows, heads).save(out, quality=88, optimize=True)


def sheets(photos, pictures, out):
    """Sheets of the shared exemplars, from pictures that `variants` left."""
    out.mkdir(parents=True, exist_ok=True)
    shown = [name for name in photos if (pictures / f"{name}-design-0.png").exists()]
    for start in range(0, len(shown), 5):
        rows = []
        for name in shown[start : start + 5]:
            cells = [(crop(photos[name], SIDE), name)]
            shown_ways = ["graphcut", *["design"] * 5]
            for way, number in zip(shown_ways, (0, 0, 1, 2, 3, 4), strict=True):
                cells.append((pictures / f"{name}-{way}-{number}.png", f"seed {number}"))
            rows.append(cells)
        heads = ["exemplar", "graphcut", *["design"] * 5]
        page(rows, heads).save(out / f"designs_{start // 5 + 1}.png")


def table(report):
    """The results as a page of Markdown."""
    lines = ["# Designs by deformed layers", "", "Written by `benchmarks/design.py`.", ""]
    if "table2" in report:
        lines += [
            "## Fast layer-based design (table 2 of Shen et al. 2010)", "",
            "360 x 360 pixels from exemplars of at most 144 pixels a side, means of "
            f"{len({r['exemplar'] for r in report['table2']['rows']})} exemplars, one thread. "
            "`all` is the whole design; `search` the searches for patches alone; `energy` the "
            "mean matching cost over that of the exhaustive search.", "",
            "| patch | search | CPU s | all, times faster | search, times faster | energy |",
            "|---|---|---|---|---|---|",
        ]  # fmt: skip
        for patch, found in report["table2"]["summary"].items():
            for search, v in found.items():
                lines.append(
                    f"| {patch} | {search} | {v['cpu']:.2f} | {v['faster']:.1f} | "
                    f"{v['search_faster']:.1f} | {v['energy_ratio']:.3f} |"
                )
    if "variants" in report:
        keys = ("cpu", "swd", "offsets", "bend", "diversity", "nn", "nn_turned",
                "swd_exemplar",
                "sharp", "swd_ratio", "offsets_ratio", "nn_ratio", "nn_within_20%")  # fmt: skip
        count = len({r["exemplar"] for r in report["variants"]["rows"]})
        lines += [
            "", "## Variants", "",
            f"256 x 256 pixels from 128, {report['variants'].get('count', 10)} seeds, means of "
            f"{count} exemplars; ratios are medians of those to graphcut on the same exemplar; the "
            "last column counts exemplars.", "",
            "| way | " + " | ".join(keys) + " |", "|---" * (len(keys) + 1) + "|",
        ]  # fmt: skip
        for way, v in report["variants"]["summary"].items():
            lines.append(f"| {way} | " + " | ".join(f"{v[key]:.3g}" for key in keys) + " |")
        lines += ["", "| exemplar | way | cpu | swd | bend | nn | sharp |",
                  "|---|---|---|---|---|---|---|"]  # fmt: skip
        for r in report["variants"]["rows"]:
            cells = (f"{r[k]:.3g}" for k in ("cpu", "swd", "bend", "nn", "sharp"))
            lines.append(f"| {r['exemplar']} | {r['way']} | " + " | ".join(cells) + " |")
    if "workers" in report:
        w = report["workers"]
        lines += ["", "## Two cores", ""]
        lines.append(
            f"Ten variants of one exemplar: {w['one']:.1f} s with one worker, {w['two']:.1f} s "
            "with two, processes started included."
        )
    return "\n".join(lines) + "\n"


def both_cores(photos):
    """Wall seconds of ten variants with one worker and with two."""
    exemplar = crop(next(iter(photos.values())), SIDE)
    one = once(designs, exemplar, SIZE, 10, workers=1)[1]["seconds"]
    return {"one": one, "two": once(designs, exemplar, SIZE, 10, workers=2)[1]["seconds"]}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, threads=1, sections="table2,variants,workers")
    parser.add_argument("--pictures", type=Path, default=Path("out/designs"), metavar="DIR")
    parser.add_argument("--sheets", type=Path, metavar="DIR", help="draw sheets of them there")
    parser.add_argument("--docs", type=Path, metavar="JPG", help="draw the bundled exemplars")
    parser.add_argument(
        "--ways",
        default="graphcut; design; design, upright",
        help="of variants; also design, layers",
    )
    parser.add_argument("--count", type=int, default=10, help="variants of each way")
    parser.add_argument("--names", default=",".join(NAMES))
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.docs is not None:
        bundled(options.docs)
        return
    known = photos_of(options)
    photos = {name: known[name] for name in options.names.split(",") if name in known} or known
    if options.sheets is not None:
        sheets(photos, options.pictures, options.sheets)
        return
    file = options.out / "design.json"

    def keep(found):  # what there is after each exemplar
        report = json.loads(file.read_text()) if file.exists() else {}
        file.write_text(json.dumps(report | {"variants": found}, indent=1) + "\n")
        (options.out / "design.md").write_text(table(report | {"variants": found}))

    sections = {
        "table2": lambda: table2(photos),
        "variants": lambda: variants(
            photos, options.pictures, keep, options.ways.split("; "), options.count
        ),
        "workers": lambda: both_cores(photos),
    }
    about = {"environment": environment(options.threads, "PyMaxflow")}
    report = measured(file, about, sections, options.sections)
    (options.out / "design.md").write_text(table(report))


if __name__ == "__main__":
    main()
