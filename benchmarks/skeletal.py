"""Skeletal synthesis against `synthesize`: time, quality, and the choices that were made.

    python benchmarks/skeletal.py --sections curves,quality,table

Sections: `curves`, `quality`, `sheet` and `table`.

`curves` takes CPU seconds of both, at outputs of 128 to 1024 pixels from exemplars of 128, with the
default windows and with 13 x 13 alone: the curves of fig. 4 of Pan et al. 2009. `curves 512` does
one size.

`quality` compares at 256 pixels: levels, wavelets, phases, seams moved and mended or not, a
refinement, and the paper's own way, an averaged coarse band under copied details. None of these
exemplars was looked at when windows and iterations were chosen. `blocks` is the mean step
across borders of blocks of 2 pixels over that inside them, 1 where no block shows; `sharp` is the
mean step between neighbors over that of the exemplar.

`sheet` draws the bundled exemplars, `table` writes the Markdown.
"""

import argparse
import json
import statistics
from functools import partial

import torch
from common import add_arguments, environment, measured, once, photos_of
from exemplars import BUNDLED, crop, load
from PIL import Image, ImageDraw, ImageFont

from torchtex import metrics
from torchtex.recipes.skeleton import refine, skeleton
from torchtex.recipes.skeleton_blocks import BlockShape
from torchtex.schedule import Level
from torchtex.synthesize import synthesize
from torchtex.wavelets import Coefficients, blocks_at, every_shift, reconstruct

SIDE = 128
SHOWN = 256
SIZES = {128: 8, 256: 8, 512: 4, 1024: 4}
PHOTOS = ("brick_tan", "leaves_green", "pebbles_mixed", "houndstooth_weave", "coffee_beans",
          "moss_ground", "granite_speckled", "stone_blocks")  # fmt: skip
THIRTEEN = (Level(0.25, 13, 3), Level(0.5, 13, 4), Level(1.0, 13, 4))
COARSE_THIRTEEN = (Level(0.5, 13, 3), Level(1.0, 13, 2, complete=True))
WAYS = {
    "level 1": {},
    "level 1, not mended": {"mend": False},
    "level 1, seams left": {"cut": "none"},
    "level 1, db2": {"wavelet": "db2"},
    "level 1, 4 phases": {"phases": 2},
    "level 2": {"levels": 2},
    "level 2, not mended": {"levels": 2, "mend": False},
    "level 3": {"levels": 3},
    "level 3, not mended": {"levels": 3, "mend": False},
}


def step_sizes(x, dim):
    """Mean step between neighbors, for each line along one axis."""
    n = x.shape[dim]
    gap = (x.narrow(dim, 1, n - 1) - x.narrow(dim, 0, n - 1)).abs()
    return gap.mean((0, 3 - dim))


def looks(x, exemplar):
    """The measures of one texture."""
    steps, theirs = ([step_sizes(image, dim) for dim in (1, 2)] for image in (x, exemplar))
    across = torch.cat([line[1::2] for line in steps]).mean()
    inside = torch.cat([line[0::2] for line in steps]).mean()
    return {
        "swd": metrics.swd(x, exemplar),
        "tail": metrics.tail(x, exemplar),
        "sharp": float(torch.cat(steps).mean() / torch.cat(theirs).mean()),
        "blocks": float(across / inside),
    }


def averaged(exemplar, size, seed):
    """The paper's way: an averaged coarse band, and details of the place that weighs most."""
    shape = BlockShape(size, 1, "haar", 1, "free")
    space = shape.places([exemplar], [None])
    pictures, masks, corners = shape.exemplars([shape.coarse(exemplar)], space)
    made = synthesize(pictures, shape.blocks, masks=masks, seed=seed)
    places = shape.origins(made.source_map, corners)
    found = blocks_at([every_shift(exemplar, "haar", 1)], places)
    bands = Coefficients(made.texture * shape.side, found.details, found.size, "haar")
    return reconstruct(bands).clamp(0, 1)


def quality(photos):
    """One row for each exemplar and way."""
    rows, size = [], (SHOWN, SHOWN)
    for name in PHOTOS:
        z = crop(photos[name], SIDE)

        def add(way, x, spent, name=name, z=z):
            rows.append({"exemplar": name, "way": way} | looks(x, z) | spent)

        synthesize(z, (64, 64))
        made, spent = once(synthesize, z, size)
        add("synth", made.texture, spent)
        for way, options in WAYS.items():
            made, spent = once(skeleton, z, size, **options)
            add(way, made.texture, spent)
            if way == "level 1":
                done, more = once(refine, made, z)
                spent = {key: spent[key] + more[key] for key in spent}
                add("level 1, refined once", done.texture, spent)
        x, spent = once(averaged, z, size, 0)
        add("level 1, band averaged", x, spent)
        print(
            name,
            *(f"{r['way']}: {r['swd']:.3f}" for r in rows if r["exemplar"] == name),
            sep="  ",
            flush=True,
        )
    return rows


def curves(photos, side):
    """CPU seconds, and the distance of patches, of both methods at one size."""
    rows = []
    plain = partial(skeleton, mend=False)
    ways = {
        "default": (None, None, skeleton),
        "13 x 13": (THIRTEEN, COARSE_THIRTEEN, skeleton),
        "13 x 13, not mended": (THIRTEEN, COARSE_THIRTEEN, plain),
    }
    for name in PHOTOS[: SIZES[side]]:
        z = crop(photos[name], SIDE)
        synthesize(z, (64, 64))
        skeleton(z, (64, 64))
        for windows, (whole, coarse, short) in ways.items():
            row = {"exemplar": name, "size": side, "windows": windows}
            for way, make, plan in (("synth", synthesize, whole), ("skeleton", short, coarse)):
                made, spent = once(make, z, (side, side), schedule=plan)
                row |= {f"{way} cpu": spent["cpu"]}
                row |= {f"{way} swd": metrics.swd(made.texture, z)}
            rows.append(row | {"faster": row["synth cpu"] / row["skeleton cpu"]})
            print(*rows[-1].items(), flush=True)
    return rows


def mean_of(rows, keys):
    """Means of the columns that are numbers."""
    return {key: statistics.mean(row[key] for row in rows) for key in keys}


def table(report):
    """The report as Markdown."""
    out = ["# Skeletal synthesis", ""]
    about = report["environment"]
    out += [
        f"Exemplars of {SIDE} px, torch {about['torch']}, one thread, CPU seconds of that thread; "
        f"commit {about['commit']}. Written by `benchmarks/skeletal.py`.",
        "",
    ]
    rows = [row for side in SIZES for row in report.get(f"curves {side}", ())]
    if rows:
        out += [
            "## Time, and distance of patches, at equal output",
            "",
            "| output | windows | exemplars | synth s | skeleton s | faster (least) | swd synth | "
            "swd skeleton | ratio |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        for side in SIZES:
            for windows in ("default", "13 x 13", "13 x 13, not mended"):
                some = [r for r in rows if (r["size"], r["windows"]) == (side, windows)]
                if not some:
                    continue
                m = mean_of(some, ("synth cpu", "skeleton cpu", "synth swd", "skeleton swd"))
                least = min(row["faster"] for row in some)
                out.append(
                    f"| {side} | {windows} | {len(some)} | {m['synth cpu']:.2f} | "
                    f"{m['skeleton cpu']:.2f} | {m['synth cpu'] / m['skeleton cpu']:.1f}x "
                    f"({least:.1f}x) | {m['synth swd']:.3f} | {m['skeleton swd']:.3f} | "
                    f"{m['skeleton swd'] / m['synth swd']:.2f} |"
                )
        out.append("")
    if "quality" in report:
        keys = ("cpu", "swd", "tail", "sharp", "blocks")
        base = {r["exemplar"]: r for r in report["quality"] if r["way"] == "synth"}
        out += [
            f"## Choices, {SHOWN} px, mean of {len(base)} exemplars",
            "",
            "| way | s | swd | tail | sharp | blocks | swd over synth: mean, worst |",
            "|---|---|---|---|---|---|---|",
        ]
        for way in dict.fromkeys(r["way"] for r in report["quality"]):
            some = [r for r in report["quality"] if r["way"] == way]
            m = mean_of(some, keys)
            over = [r["swd"] / base[r["exemplar"]]["swd"] for r in some]
            out.append(
                f"| {way} | {m['cpu']:.2f} | {m['swd']:.3f} | {m['tail']:.3f} | "
                f"{m['sharp']:.2f} | {m['blocks']:.2f} | {statistics.mean(over):.2f}, "
                f"{max(over):.2f} |"
            )
        out.append("")
    return "\n".join(out)


def sheet(named, columns=("synth", "level 1", "level 2", "level 3")):
    """Each exemplar, and what the ways make of it, pixel for pixel."""
    font, line, gap = ImageFont.load_default(size=14), 22, 8
    width = gap + SIDE + gap + len(columns) * (SHOWN + gap)
    page = Image.new("RGB", (width, line + len(named) * (SHOWN + gap)), "white")
    draw = ImageDraw.Draw(page)
    for number, column in enumerate(columns):
        draw.text((2 * gap + SIDE + number * (SHOWN + gap), 2), column, "black", font)
    for row, (name, photo) in enumerate(named.items()):
        z, top = crop(photo, SIDE), line + row * (SHOWN + gap)
        found = {"synth": synthesize(z, (SHOWN, SHOWN)).texture}
        for levels in (1, 2, 3):
            made = skeleton(z, (SHOWN, SHOWN), levels=levels)
            found[f"level {levels}"] = made.texture
        page.paste(picture(z), (gap, top))
        draw.text((gap, top + SIDE + 4), name, "black", font)
        for number, column in enumerate(columns):
            page.paste(picture(found[column]), (2 * gap + SIDE + number * (SHOWN + gap), top))
        print(name, flush=True)
    return page


def picture(x):
    """A tensor as a picture."""
    return Image.fromarray((x.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy())


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, threads=1, sections="curves,quality,table")
    parser.add_argument("--sheet", default="docs/sheet_skeletal.jpg", help="picture of `sheet`")
    parser.add_argument("--shown", help="names for `sheet`; the bundled exemplars unless given")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    photos = photos_of(options)
    wanted = options.sections.split(",")
    if "sheet" in wanted:
        named = {path.stem: load(path) for path in sorted(BUNDLED.glob("*.png"))}
        if options.shown:
            named = {name: photos[name] for name in options.shown.split(",")}
        sheet(named).save(options.sheet, quality=88, optimize=True)
    sections = {f"curves {side}": partial(curves, photos, side) for side in SIZES}
    sections["quality"] = partial(quality, photos)
    if "curves" in wanted:
        wanted += [f"curves {side}" for side in SIZES]
    about = {"environment": environment(options.threads, "PyMaxflow")}
    file = options.out / "skeletal.json"
    chosen = ",".join(name for name in wanted if name in sections)
    if chosen:
        measured(file, about, sections, chosen)
    if "table" in wanted:
        (options.out / "skeletal.md").write_text(table(json.loads(file.read_text())))


if __name__ == "__main__":
    main()
