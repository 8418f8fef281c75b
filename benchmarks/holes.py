"""Completed holes and numbers of elements: sharpness, borders, what is refused, as JSON.

`complete` fills nine holes of each photo from its own texture. `sharp` is the mean step from pixel
to pixel in the holes over that of the photo, and `source` the same of the places that patches were
taken from: what lies between them is lost by joining. `plain` is `sharp` with `fresh=0` and
`detail=0`, by what fits alone. `seam` is the mean step across borders of holes over that inside.

`disc` fills one disc at a time, at five places of a crop from the middle. `sharp` is the mean step
inside over that in a ring around it, and `least_sharp` that of the worst place; `seam` is the mean
step across the border over that in the ring. `true` is `sharp` of the photo itself, `plain`
that of `detail=0`.

`density` asks for half and for one and a half of the elements that are found. Photos that are
heaps, without a ground, should be refused.
"""

import argparse

import torch
from common import add_arguments, environment, measured, once, photos_of
from exemplars import crop
from fill import steps

from torchtex.layers.elements import find_elements
from torchtex.recipes.completion import complete
from torchtex.recipes.density import density

SIDE, HOLE, PATCH = 160, 24, 16
MIDDLE, RADIUS, RING = 128, 20, 36
CENTRES = ((40, 80), (80, 40), (64, 64), (40, 40), (85, 85))
HOLED = (
    "maple_leaves", "granite_speckled", "pebbles_mixed", "leaves_green", "flowers_meadow",
    "strawberries", "olives", "brick_tan", "gravel_gray", "bark_ridged", "grass_lawn",
    "moss_ground", "leaf_litter",
)  # fmt: skip
WITH_GROUND = ("flowers_meadow", "granite_speckled", "leaf_litter")
HEAPS = ("pebbles_mixed", "coffee_beans", "olives", "strawberries", "gravel_gray", "leaves_green")


def holes(size):
    """Nine squares."""
    mask = torch.zeros(size, dtype=torch.bool)
    for i in range(3):
        for j in range(3):
            top, left = (
                round((2 * k + 1) * n / 6 - HOLE / 2) for k, n in zip((i, j), size, strict=True)
            )
            mask[top : top + HOLE, left : left + HOLE] = True
    return mask


def local_steps(image):
    """Mean step to the right and down, at every pixel."""
    down, right = (image.diff(dim=axis).abs().mean(0) for axis in (1, 2))
    return (
        torch.nn.functional.pad(down, (0, 0, 0, 1)) + torch.nn.functional.pad(right, (0, 1))
    ) / 2


def completed(photos):
    """One row for each photo."""
    rows = []
    for name in (n for n in HOLED if n in photos):
        photo = crop(photos[name], SIDE)
        mask = holes(photo.shape[1:])
        whole, local = steps(photo, torch.ones_like(mask))[1], local_steps(photo)
        done, spent = once(complete, photo, mask, patch=PATCH)
        plain = complete(photo, mask, patch=PATCH, fresh=0.0, detail=0.0)
        across, inside = steps(done.texture, mask)
        _, row, col = done.source_map[mask].unbind(-1)
        rows.append({
            "name": name, **spent, "sharp": inside / whole,
            "source": float(local[row, col].mean() / local.mean()),
            "plain": steps(plain.texture, mask)[1] / whole, "seam": across / inside,
        })  # fmt: skip
        print({k: round(v, 3) if isinstance(v, float) else v for k, v in rows[-1].items()})
    return {"rows": rows}


def discs(photos):
    """One row for each photo that is large enough."""
    rows, lines = [], torch.arange(MIDDLE)
    for name in (n for n in HOLED if n in photos and min(photos[n].shape[1:]) >= MIDDLE):
        top, left = ((n - MIDDLE) // 2 for n in photos[name].shape[1:])
        photo = photos[name][:, top : top + MIDDLE, left : left + MIDDLE]
        sharp, plain, true, seam = [], [], [], []
        for y, x in CENTRES:
            far = (lines[:, None] - y) ** 2 + (lines - x) ** 2
            mask, ring = far <= RADIUS**2, (far > RADIUS**2) & (far <= RING**2)
            around = steps(photo, ring)[1]
            across, inside = steps(complete(photo, mask).texture, mask)
            sharp.append(inside / around)
            seam.append(across / around)
            plain.append(steps(complete(photo, mask, detail=0.0).texture, mask)[1] / around)
            true.append(steps(photo, mask)[1] / around)
        kinds = {"sharp": sharp, "plain": plain, "true": true}
        row = {key: sum(values) / len(values) for key, values in {**kinds, "seam": seam}.items()}
        row |= {f"least_{key}": min(values) for key, values in kinds.items()}
        rows.append({"name": name, **row})
        print({k: round(v, 3) if isinstance(v, float) else v for k, v in rows[-1].items()})
    return {"rows": rows}


def numbers(photos):
    """One row for each photo and amount."""
    rows = []
    for name in (n for n in (*WITH_GROUND, *HEAPS) if n in photos):
        photo = crop(photos[name], SIDE)
        elements = find_elements(photo)
        for amount in (0.5, 1.5):
            row = {"name": name, "heap": name in HEAPS, "amount": amount, "found": elements.count}
            try:
                done, spent = once(density, photo, amount, elements=elements, seed=1)
            except ValueError as error:
                row |= {"refused": str(error)}
            else:
                row |= {"after": done.settings["after"], **spent}
            rows.append(row)
            print(row)
    return {"rows": rows}


def table(report):
    """The results as a page of Markdown."""
    lines = ["# Holes and elements", "", "Written by `benchmarks/holes.py`.", ""]
    if "complete" in report:
        lines += [
            f"## Nine holes of {HOLE} pixels, patches of {PATCH}", "",
            "| photo | CPU s | sharp | of the sources | by fit alone | seam |",
            "|---|--:|--:|--:|--:|--:|",
        ]  # fmt: skip
        for r in report["complete"]["rows"]:
            cells = (f"{r[k]:.2f}" for k in ("cpu", "sharp", "source", "plain", "seam"))
            lines.append(f"| {r['name']} | " + " | ".join(cells) + " |")
    if "disc" in report:
        lines += [
            "", f"## A disc of {2 * RADIUS} pixels, at {len(CENTRES)} places: mean and least", "",
            "| photo | sharp | least | with detail=0 | least | the photo itself | least | seam |",
            "|---|--:|--:|--:|--:|--:|--:|--:|",
        ]  # fmt: skip
        for r in report["disc"]["rows"]:
            kinds = [k for kind in ("sharp", "plain", "true") for k in (kind, f"least_{kind}")]
            cells = (f"{r[k]:.2f}" for k in (*kinds, "seam"))
            lines.append(f"| {r['name']} | " + " | ".join(cells) + " |")
    if "density" in report:
        lines += [
            "", "## Half and one and a half of the elements", "",
            "| photo | a heap | found | times | after | CPU s |", "|---|---|--:|--:|--:|--:|",
        ]  # fmt: skip
        for r in report["density"]["rows"]:
            after = "refused" if "refused" in r else r["after"]
            cpu = "" if "refused" in r else f"{r['cpu']:.2f}"
            heap = "yes" if r["heap"] else "no"
            cells = (r["name"], heap, r["found"], r["amount"], after, cpu)
            lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_arguments(parser, threads=1, sections="complete,disc,density")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    photos, file = photos_of(options), options.out / "holes.json"
    sections = {
        "complete": lambda: completed(photos),
        "disc": lambda: discs(photos),
        "density": lambda: numbers(photos),
    }
    about = {"environment": environment(options.threads)}
    report = measured(file, about, sections, options.sections)
    (options.out / "holes.md").write_text(table(report))


if __name__ == "__main__":
    main()
