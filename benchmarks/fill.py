"""Holes of a quarter of a photo, filled: likeness, borders, sharpness and time, as JSON.

`nn` is the mean distance of the 7 x 7 windows around each pixel of the hole to the nearest window
of known pixels, over the same for known windows, whose nearest must lie 8 pixels away or more; a
fresh photo gives about 1, as `truth` shows for what was there before, and copies give less.
`seam` is the mean step across the border of the hole over the mean step inside it, for the
original photo too. `sharp` is the mean step in the hole over that of the photo there.

`blended` is the texture of the EM solver, begun from the filled hole with its border as a soft
constraint: every pixel is a mean of several sources, and so copies less.
"""

import argparse
import json

import common
import torch
import torch.nn.functional as F
from exemplars import crop

from torchtex.controls import SoftConstraint
from torchtex.image import save
from torchtex.recipes.fill import fill
from torchtex.schedule import Level
from torchtex.synthesize import synthesize

NAMES = (
    "olives", "gravel_gray", "brick_tan", "keyboard", "leaves_green", "coffee_beans",
    "grass_lawn", "pebbles_mixed", "moss_ground", "leaf_litter",
)  # fmt: skip
SIDE, PATCH, APART = 192, 7, 8


def windows(image):
    return F.unfold(image[None], PATCH)[0].T


def nearest(queries, places, keys, key_places, apart):
    """Mean squared distance to the nearest key that is so far away."""
    norms, found = keys.square().sum(1), []
    for some, place in zip(queries.split(1024), places.split(1024), strict=True):
        far = some.square().sum(1, True) + norms - 2 * some @ keys.T
        if apart:
            close = (place[:, None] - key_places[None]).abs().amax(2) < apart
            far = far.masked_fill(close, torch.inf)
        found.append(far.amin(1).clamp(min=0))
    return float(torch.cat(found).mean())


def steps(image, hole):
    """Mean step across the border of the hole, and inside it."""
    across, inside = [], []
    for axis in (0, 1):
        step, n = image.diff(dim=axis + 1).abs().mean(0), hole.shape[axis] - 1
        one, other = hole.narrow(axis, 0, n), hole.narrow(axis, 1, n)
        across.append(step[one != other])
        inside.append(step[one & other])
    return float(torch.cat(across).mean()), float(torch.cat(inside).mean())


def measured(filled, photo, hole):
    """The figures of one hole."""
    h, w = (n - PATCH + 1 for n in hole.shape)
    places = torch.cartesian_prod(torch.arange(h), torch.arange(w))
    holes = F.unfold(hole[None, None].float(), PATCH)[0]
    known, centred = holes.sum(0) == 0, holes[PATCH**2 // 2] > 0
    ours, theirs = windows(filled), windows(photo)
    keys, key_places = ours[known], places[known]
    some = known.nonzero().flatten()[::8]
    outside = nearest(ours[some], places[some], keys, key_places, APART)
    across, inside = steps(filled, hole)
    true_across, true_inside = steps(photo, hole)
    return {
        "nn": nearest(ours[centred], places[centred], keys, key_places, 0) / outside,
        "truth": nearest(theirs[centred], places[centred], keys, key_places, 0) / outside,
        "seam": across / inside,
        "seam_truth": true_across / true_inside,
        "sharp": inside / true_inside,
    }


def blended(photo, hole, filled):
    """The hole as a mean of windows from several places."""
    known = SoftConstraint(torch.where(hole, 0, photo), (~hole).to(photo))
    levels = (Level(0.5, 8, 4), Level(1.0, 8, 4))
    result = synthesize(
        torch.where(hole, 0, photo), tuple(photo.shape[1:]), masks=~hole, init=filled,
        schedule=levels, controls=[(10.0, known)],
    )  # fmt: skip
    return torch.where(hole, result.texture, photo)


def square(size):
    """A hole of a quarter of the pixels, in the middle."""
    hole = torch.zeros(size, dtype=torch.bool)
    h, w = size
    hole[h // 4 : h // 4 + h // 2, w // 4 : w // 4 + w // 2] = True
    return hole


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    common.add_arguments(parser, threads=1)
    parser.add_argument("--pictures", action="store_true", help="write each result beside --out")
    parser.add_argument("--names", default=",".join(NAMES))
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    photos, rows = common.photos_of(options), []
    for name in options.names.split(","):
        photo = crop(photos[name], SIDE)
        hole = square(photo.shape[1:])
        for poisson in (False, True):
            result, spent = common.once(fill, photo, hole, poisson=poisson)
            texture = result.texture
            row = {"name": name, "size": list(photo.shape[1:]), "poisson": poisson, **spent}
            rows.append(row | measured(texture, photo, hole))
            if options.pictures:
                file = options.out / f"fill_{name}{'_poisson' if poisson else ''}.png"
                save(file, torch.cat([texture, photo], 2))
        rows[-1]["blended"] = measured(blended(photo, hole, texture), photo, hole)
        print(name, {k: round(v, 3) if isinstance(v, float) else v for k, v in rows[-1].items()})
    report = {"environment": common.environment(options.threads), "side": SIDE, "rows": rows}
    (options.out / "fill.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
