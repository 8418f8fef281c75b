"""Speed, accuracy and memory of the Poisson solvers, as JSON and a line per case.

Each case clones the gradients of one picture into another of 0.25, 1 or 4 megapixels in RGB and
float32, in a process of its own, so that peak memory is its. Cases: `sine` (a rectangle one pixel
inside the border), `cosine` (the whole image, free borders), `wave` (the whole image, periodic),
`mask` (an irregular blob with holes, half of all pixels) and `iterative` (the rectangle again,
by the solver for any mask).

The residual is that of the true discrete operator, taken in float64: the norm of the energy's
slope inside the mask over the norm of the right side b of A f = b (`residual`; b holds the given
values at the border), and over the norm of the slope at the start (`of_start`, the stricter one).
"""

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path

import torch
import torch.nn.functional as F
from common import add_arguments, environment, measured, once, photo_files, timed
from exemplars import load

from torchtex.cuts.poisson import Guidance, gradients, solve

CASES = {"sine": "auto", "cosine": "auto", "wave": "auto", "mask": "auto", "iterative": "iterative"}
SIDES = (512, 1024, 2048)
# what the project asks for: seconds at one megapixel, and the residual at any size
SECONDS = {"sine": 1.0, "cosine": 1.0, "wave": 1.0, "mask": 5.0}
RESIDUAL = 1e-4


def blob(side, seed=0):
    """Half of all pixels: smooth noise of several scales above its median, off the border."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.zeros(1, 1, side, side)
    for cells, weight in ((4, 1.0), (9, 0.6), (24, 0.35), (64, 0.2)):
        coarse = torch.randn(1, 1, cells, cells, generator=generator)
        noise += weight * F.interpolate(coarse, size=(side, side), mode="bicubic")
    mask = noise[0, 0] > noise.median()
    mask[0] = mask[-1] = mask[:, 0] = mask[:, -1] = False
    return mask


def picture(photo, side, seed=0):
    """A photo repeated, mirrored, to side x side, with a little noise so that no two are alike."""
    wide = torch.cat([photo, photo.flip(-1)], -1)
    whole = torch.cat([wide, wide.flip(-2)], -2)
    times = [-(-side // extent) for extent in whole.shape[1:]]
    generator = torch.Generator().manual_seed(seed)
    grain = torch.rand(3, side, side, generator=generator)
    return (whole.repeat(1, *times)[:, :side, :side] * 0.95 + 0.05 * grain).contiguous()


def slope(image, guidance, mask):
    """A f - b inside the mask, from the energy itself: half of its derivative."""
    image = image.clone().requires_grad_()
    ours = gradients(image, periodic=guidance.periodic)
    right, down = ours.right - guidance.right, ours.down - guidance.down
    ((right.square().sum() + down.square().sum()) / 2).backward()
    return image.grad * mask


def residuals(found, guidance, base, mask):
    """Norms of the slope over that of b and over that at the start, in float64."""
    wide = Guidance(guidance.right.double(), guidance.down.double(), guidance.periodic)
    left = slope(found.double(), wide, mask).norm()
    b = slope(torch.where(mask, 0.0, base).double(), wide, mask).norm()
    return float(left / b), float(left / slope(base.double(), wide, mask).norm())


def child(case, side, threads, repeats, source, base):
    """One case; prints JSON."""
    torch.set_num_threads(int(threads))
    side = int(side)
    source, base = picture(load(Path(source)), side, 1), picture(load(Path(base)), side, 2)
    mask = torch.ones(side, side, dtype=torch.bool)
    if case == "mask":
        mask = blob(side)
    elif case in ("sine", "iterative"):
        mask[0] = mask[-1] = mask[:, 0] = mask[:, -1] = False
    guidance = gradients(source, periodic=case == "wave")

    def work():
        return solve(guidance, base, mask, boundary="free", method=CASES[case])

    idle = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    found, spent = once(work)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    residual, of_start = residuals(found, guidance, base, mask)
    row = {"case": case, "side": side, "megapixels": side * side / 2**20}
    row |= {
        "share": float(mask.float().mean()),
        "seconds": timed(work, int(repeats)),
        "cpu_s": spent["cpu"],
    }
    row |= {"residual": residual, "of_start": of_start, "idle_mib": idle, "peak_mib": peak}
    print(json.dumps(row))


def rows_of(options):
    """One row for each size and case, measured in a process of its own."""
    photos, rows = photo_files(options), []
    for side in options.sides:
        for case in CASES:
            settings = (case, side, options.threads, options.repeats, photos[0], photos[-1])
            command = [sys.executable, __file__, "--child", *map(str, settings)]
            out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            row = json.loads(out.splitlines()[-1])
            if row["megapixels"] == 1 and case in SECONDS:
                row["target_s"] = SECONDS[case]
                row["met"] = row["seconds"]["median"] <= SECONDS[case]
            row["accurate"] = row["of_start"] < RESIDUAL
            rows.append(row)
            print(
                f"{case} {row['megapixels']:.2f} MP: {row['seconds']['median']:.2f} s "
                f"({row['cpu_s']:.2f} s of CPU), residual "
                f"{row['residual']:.1e} ({row['of_start']:.1e} of the start), "
                f"{row['peak_mib'] - row['idle_mib']:.0f} MiB",
                flush=True,
            )
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, threads=1, repeats=3, sections="poisson")
    parser.add_argument("--sides", type=int, nargs="+", default=SIDES, help="of the images")
    parser.add_argument("--child", nargs=6, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        return child(*options.child)
    about = {"environment": environment(options.threads)}
    sections = {"poisson": lambda: rows_of(options)}
    measured(options.out / "poisson.json", about, sections, options.sections)
    return None


if __name__ == "__main__":
    main()
