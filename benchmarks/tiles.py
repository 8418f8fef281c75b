"""Textures that tile, three ways, and Wang tiles: seams, fidelity and time, as JSON and a table.

Sections: `cyclic` and `wang`.

`cyclic` makes every photo, cropped, into a tile: by the paper's recipe (a quarter overlaps, opened
in the middle), by the search for the overlap, each with paths and with a min-cut, and with a
Poisson solve after it; and `synthesize(boundary="periodic")` makes one of the same size. `border`
and `border_worst` are `metrics.seam` of the tile, the second for its worst 16 pixels: 1.1 is 10 %
more than inside. The border of a cut tile lies where nothing was cut, so its seams are measured
too, along the cut, by `seam_visibility`.

`wang` lays tiles of 64 px to 512 x 512, with patches that are searched for and with random ones.
"""

import argparse
import statistics

import torch
from common import add_arguments, environment, measured, once, photos_of
from exemplars import crop

import torchtex
from torchtex import metrics
from torchtex.recipes.cyclic import BestOverlap, cyclic, seam_visibility
from torchtex.recipes.tile_parts import Choice
from torchtex.recipes.wang import wang_tiles

SIDE = 256
WAYS = {
    "paper dp": {"cut": "dp", "opening": "half"},
    "paper mincut": {"cut": "mincut", "opening": "half"},
    "best dp": {"cut": "dp", "overlap": BestOverlap()},
    "best mincut": {"cut": "mincut", "overlap": BestOverlap()},
    "best mincut poisson": {"cut": "mincut", "overlap": BestOverlap(), "poisson": True},
}


def looks(tile, texture):
    """Seams at the border of a tile, and a distance of its patches to those of the texture."""
    return {
        "border": metrics.seam(tile),
        "border_worst": metrics.seam(tile, segment=16),
        "swd": metrics.swd(tile, texture),
    }


def cyclic_rows(photos):
    """One row for each photo and way."""
    rows = []
    for name, photo in photos.items():
        texture = crop(photo, SIDE)
        size = texture.shape[1:]
        for way, options in WAYS.items():
            overlap = options.get("overlap", (size[0] // 4, size[1] // 4))
            tile, spent = once(cyclic, texture, **(options | {"overlap": overlap}))
            cut = seam_visibility(tile)
            row = {"exemplar": name, "way": way, "size": list(tile.texture.shape[1:])}
            row |= looks(tile.texture, texture)
            rows.append(row | {"cut": cut.mean, "cut_worst": cut.worst} | spent)
        extent = tuple(rows[-1]["size"])
        made, spent = once(torchtex.synthesize, texture, extent, boundary="periodic")
        row = {"exemplar": name, "way": "synthesize periodic", "size": list(extent)}
        rows.append(row | looks(made.texture, texture) | spent)
        print(name, *(f"{r['way']}: {r['border']:.2f}" for r in rows[-6:]), sep="  ", flush=True)
    return rows


def wang_rows(photos):
    """One row for each photo and way."""
    rows = []
    ways = {
        "mincut": {},
        "dp": {"cut": "dp"},
        "mincut random": {"choice": Choice(1, 1, 1)},
        "mincut 3 colours": {"colors": 3},
    }
    for name, photo in list(photos.items()):
        exemplar = crop(photo, SIDE)
        if min(exemplar.shape[1:]) < 160:
            continue
        for way, options in ways.items():
            tiles, spent = once(wang_tiles, exemplar, tile=64, **options)
            whole, laid = once(tiles.tile, (512, 512), seed=1)
            x = whole.texture[:, :256, :256]
            row = {"exemplar": name, "way": way, "tiles": len(tiles.tiles)}
            row |= {"step": _step(tiles), "swd": metrics.swd(x, exemplar)}
            row |= {"repeat": metrics.repeat(x, exemplar)}
            rows.append(row | spent | {"laying": laid["seconds"]})
        print(name, *(f"{r['way']}: {r['step']:.2f}" for r in rows[-4:]), sep="  ", flush=True)
    return rows


def _step(tiles):
    """Mean step across the seams inside tiles, in mean steps between other neighbours."""
    places, n = tiles.positions[..., 1:], tiles.side - 1
    cut, rest = [], []
    for axis in (0, 1):
        jump = places.narrow(axis + 1, 1, n) - places.narrow(axis + 1, 0, n)
        parted = (jump != torch.tensor([1 - axis, axis])).any(-1)
        x = tiles.tiles.transpose(0, 1)
        step = (x.narrow(axis + 2, 1, n) - x.narrow(axis + 2, 0, n)).abs().mean(0)
        cut.append(step[parted])
        rest.append(step[~parted])
    return float(torch.cat(cut).mean() / torch.cat(rest).mean())


def summary(rows):
    """Means, and for borders how many exemplars are within 10 %."""
    found = {}
    for way in dict.fromkeys(row["way"] for row in rows):
        ours = [row for row in rows if row["way"] == way]
        keys = [key for key, value in ours[0].items() if isinstance(value, float)]
        mean = {key: round(statistics.mean(row[key] for row in ours), 4) for key in keys}
        for key in ("border", "border_worst", "cut", "cut_worst"):
            if key in ours[0]:
                mean[f"{key}_within_10%"] = sum(row[key] <= 1.1 for row in ours)
        found[way] = {"exemplars": len(ours)} | mean
    return found


def summed(rows):
    """Rows, and what they sum up to."""
    return {"summary": summary(rows), "rows": rows}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, threads=1, sections="cyclic,wang")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    photos = photos_of(options)
    sections = {
        "cyclic": lambda: summed(cyclic_rows(photos)),
        "wang": lambda: summed(wang_rows(photos)),
    }
    about = {"environment": environment(options.threads, "PyMaxflow")}
    report = measured(options.out / "tiles.json", about, sections, options.sections)
    for section in options.sections.split(","):
        for way, values in report[section]["summary"].items():
            print(section, way, values, flush=True)


if __name__ == "__main__":
    main()
