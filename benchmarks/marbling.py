"""Marbling and pictures of things: seams, how well a marbling can be taken back, seconds.

Every photo is cropped to 128 pixels and made a tile (`graphcut`, boundary="periodic"). Then, for
each operation with its default numbers and for a design of all of them:

- `undo`: PSNR of the tile that was marbled, rounded to 8 bits and taken back, in the size of the
  tile and, marbled in twice its size, back in its own. For a drop only pixels farther than twice
  its radius from its centre count, as what lay under its middle is drawn out to its whole rim.
- `seam`: the tile rolled by half its size, marbled by the operation moved as far, rolled back,
  less the tile marbled directly; the largest difference of any value. 0: the border of the tile is
  a place like any other.
- `jump`: the seam measure of metrics.md, before and after.

And the CPU seconds of a marbling of 512x512 by each, and of a picture of 512x512 of each thing.
"""

import argparse
import json
import math
import statistics
from dataclasses import replace

import torch
from common import add_arguments, environment, photos_of, timed
from exemplars import crop

from torchtex import data, metrics
from torchtex import image as images
from torchtex.layers.marbling import marble
from torchtex.layers.tines import Comb, Tine, Wave
from torchtex.layers.whirls import Circle, Drop, Vortex
from torchtex.meshes.shapes import SHAPES
from torchtex.recipes.graphcut import graphcut
from torchtex.render.pictures import texture_picture

SIDE = 128
SINGLE = {
    "tine": [Tine()],
    "comb": [Comb()],
    "wave": [Wave()],
    "circle": [Circle()],
    "vortex": [Vortex()],
    "drop": [Drop()],
}
DESIGN = [
    Comb(6, 90.0, 0.08), Wave(0.03, 0, 2), Vortex(0.3, 0.3, 90.0, 0.15), Tine(30.0, 0.1, 0.08),
    Circle(0.7, 0.7, 0.2, 0.1, 0.08),
]  # fmt: skip
CASES = SINGLE | {"all but drops": DESIGN}


def psnr(one, other, mask):
    error = (one - other).square().mean(0)[mask].mean()
    return -10 * math.log10(float(error.clamp(min=1e-12)))


def counted(name):
    """Pixels that the PSNR counts."""
    if name != "drop":
        return torch.ones(SIDE, SIDE, dtype=torch.bool)
    line = torch.arange(SIDE) - (SIDE - 1) / 2
    return (line[:, None] ** 2 + line**2).sqrt() > 2 * SINGLE["drop"][0].radius * SIDE


def undone(tile, operations, mask, factor):
    there = marble(tile, operations, periodic=True, size=(factor * SIDE, factor * SIDE))
    stored = (there * 255).round() / 255
    back = marble(stored, operations, periodic=True, undo=True, size=(SIDE, SIDE))
    return psnr(back, tile, mask)


def moved(operation):
    """The operation half a tile away."""
    if isinstance(operation, Wave):
        return replace(operation, phase=operation.phase - (operation.rows + operation.columns) / 2)
    return replace(operation, row=operation.row + 0.5, column=operation.column + 0.5)


def of_photo(photo):
    tile = graphcut(crop(photo, SIDE), (SIDE, SIDE), boundary="periodic", seed=1).texture
    before = metrics.seam(tile)
    rows = {}
    for name, operations in CASES.items():
        drawn = marble(tile, operations, periodic=True)
        half = tile.roll((SIDE // 2, SIDE // 2), (1, 2))
        other = marble(half, [moved(operation) for operation in operations], periodic=True)
        mask = counted(name)
        rows[name] = {
            "undo": undone(tile, operations, mask, 1),
            "undo_double": undone(tile, operations, mask, 2),
            "seam": float((other.roll((SIDE // 2, SIDE // 2), (1, 2)) - drawn).abs().max()),
            "jump": [before, metrics.seam(drawn)],
        }
    return rows


def table(photos, times):
    lines = [
        "| operation | undo, dB: median, least | photos above 35 dB | at twice the size | "
        "seam, largest | jump: median before, after | CPU s at 512x512 |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in CASES:
        rows = [photo[name] for photo in photos.values()]
        one, two = ([row[key] for row in rows] for key in ("undo", "undo_double"))
        jumps = [statistics.median(row["jump"][i] for row in rows) for i in (0, 1)]
        lines.append(
            f"| {name} | {statistics.median(one):.1f}, {min(one):.1f} "
            f"| {sum(v > 35 for v in one)} of {len(one)} "
            f"| {statistics.median(two):.1f}, {min(two):.1f}; {sum(v > 35 for v in two)} "
            f"| {max(row['seam'] for row in rows):.1e} | {jumps[0]:.2f}, {jumps[1]:.2f} "
            f"| {times[name]['cpu']:.2f} |"
        )
    return "\n".join(lines)


def sheet(path):
    """Bundled exemplars: tile, marbled, combed with ink, and both on things and on the ground."""
    rows = []
    floor = graphcut(data.load("wood"), (256, 256), boundary="periodic", seed=2).texture
    inked = [
        Drop(0.5, 0.5, 0.2, (0.93, 0.9, 0.82)), Drop(0.5, 0.5, 0.14, (0.16, 0.28, 0.42)),
        Drop(0.5, 0.5, 0.08, (0.85, 0.55, 0.2)), Comb(6, 90.0, 0.12), Comb(6, 0.0, 0.06),
    ]  # fmt: skip
    for name, things in (
        ("tissue", ("vase", "cloth")),
        ("wood", ("torus", "sphere")),
        ("bricks", ("cube", "plane")),
    ):
        tile = graphcut(data.load(name), (SIDE, SIDE), boundary="periodic", seed=1).texture
        tile = tile.expand(3, -1, -1).contiguous()
        size = (256, 256)
        marbled = marble(tile, DESIGN, periodic=True, size=size)
        inks = marble(tile, inked, periodic=True, size=size)
        shown = [
            texture_picture(marbled, things[0], ground=floor, size=size),
            texture_picture(tile if name == "bricks" else inks, things[1], normals=0.4, size=size),
        ]
        rows.append(torch.cat([images.resize(tile, size).clamp(0, 1), marbled, inks, *shown], 2))
    images.save(path, torch.cat(rows, 1))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add_arguments(parser, threads=1, repeats=3)
    parser.add_argument("--sheet", action="store_true", help="only the contact sheet")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    sheet(options.out / "sheet_marbling.jpg")
    if options.sheet:
        return
    photos = {name: of_photo(photo) for name, photo in photos_of(options).items()}
    large = torch.rand(3, 512, 512, generator=torch.Generator().manual_seed(0))
    times = {
        name: timed(lambda ops=ops: marble(large, ops, periodic=True), options.repeats)
        for name, ops in CASES.items()
    }
    tile = large[:, :256, :256].contiguous()
    shown = {
        name: timed(lambda name=name: texture_picture(tile, name), options.repeats)
        for name in SHAPES
    }
    relief = timed(lambda: texture_picture(tile, "sphere", normals=1.0, ground=tile), 3)
    shown["sphere, relief, floor"] = relief
    about = environment(options.threads)
    found = {"environment": about, "photos": photos, "marble": times, "render": shown}
    (options.out / "marbling.json").write_text(json.dumps(found, indent=1) + "\n")
    lines = [
        "# Marbling and rendering, measured",
        "",
        f"By benchmarks/marbling.py, which says what is measured; {len(photos)} photos, tiles of "
        f"{SIDE}x{SIDE}, splines of degree 3, {options.threads} thread, torch {about['torch']}.",
        "",
        table(photos, times),
        "",
        "Pictures of 512x512 with 9 samples a pixel, CPU seconds: "
        + ", ".join(f"{name} {spent['cpu']:.1f}" for name, spent in shown.items())
        + ".",
        "",
    ]
    (options.out / "marbling.md").write_text("\n".join(lines))


if __name__ == "__main__":
    main()
