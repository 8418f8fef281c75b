"""Textures along flows, against a plain warp and one that is regenerated: as JSON and a table.

Per frame: `error`, the root mean square difference from the warped frame before where the flow
shows it, new content included; `pops`, the share of 8 x 8 blocks seen there that differ by more
than 0.7 standard deviations of the exemplar. At the first and the last moved frame: `nn`, `tail`
and `swd` as in `torchtex.metrics`, and `sharp`, the mean step between neighbors over that of the
still first frame. `moved` is the nn of that still frame read half a pixel further, which is what
motion between pixels costs by itself, and `least` its error against the still frame warped as
far: what a frame as sharp as the still one cannot avoid. `fresh` is the nn of the middle of the
last frame, all of it new under a source, over that of the whole.
"""

import argparse
import json
import resource
import subprocess
import sys

import common
import torch
import torch.nn.functional as F
from exemplars import crop

from torchtex import metrics
from torchtex.flow.fields import Uniform, field_at
from torchtex.flow.formulas import Rotation, Sink, Source
from torchtex.flow.warps import invert, warp
from torchtex.image import save
from torchtex.recipes.animate import Motion, animate
from torchtex.recipes.frames import VISIBLE
from torchtex.recipes.pieces import stock_of
from torchtex.recipes.regeneration import regenerated_frames, warped_frames

FLOWS = {"source": Source(1.5), "sink": Sink(1.5), "rotation": Rotation(2.0)}
RUNS = (
    "keyboard/rotation/64", "olives/source/48", "coffee_beans/sink/48", "brick_gray/rotation/48",
    "gravel_gray/source/48", "olives/sink/48", "olives/rotation/48", "coffee_beans/rotation/48",
    "stone_blocks/rotation/48", "granite_speckled/source/48",
)  # fmt: skip
SHOWN = (0, 1, 10, 30, 60, 90, 120)


def sharp(image):
    grey = image.mean(0)
    return float(grey.diff(dim=0).abs().mean() + grey.diff(dim=1).abs().mean())


def quality(image, exemplar, still):
    return {
        "nn": metrics.nn(image, exemplar),
        "tail": metrics.tail(image, exemplar),
        "swd": metrics.swd(image, exemplar),
        "sharp": sharp(image) / sharp(still),
    }


def followed(images, field, exemplar, still, count):
    """The measures of a stream of frames, and those of them that are shown."""
    backward, seen = invert(field.to(exemplar))
    seen = seen >= VISIBLE
    whole = F.avg_pool2d(seen[None, None].float(), 8)[0, 0] > 0.99
    scale = 0.7 * float(exemplar.var((1, 2)).mean().sqrt())
    errors, pops, found, shown, last = [], [], {}, [], None
    for number, image in enumerate(images):
        if last is not None:
            gap = (image - warp(last, backward).clamp(0, 1)).square().mean(0)
            errors.append(float(gap[seen].mean().sqrt()))
            blocks = F.avg_pool2d(gap[None, None], 8)[0, 0].sqrt()
            pops.append(float((blocks[whole] > scale).float().mean()))
        if number in (1, count - 1):
            found["first" if number == 1 else "last"] = quality(image, exemplar, still)
        if number in SHOWN:
            shown.append(image)
        last = image
    side = last.shape[1]
    middle = last[:, side * 5 // 16 : side * 11 // 16, side * 5 // 16 : side * 11 // 16]
    found["fresh"] = metrics.nn(middle, exemplar) / found["last"]["nn"]
    found |= {"error": sum(errors) / len(errors), "pops": sum(pops) / len(pops)}
    return found, shown


def one(photo, flow, patch, options, file):
    """One exemplar along one flow, three ways."""
    exemplar, size = crop(photo, 128), (options.size, options.size)
    spent = []

    def timed(frames):
        while True:
            frame, used = common.once(next, frames, None)
            if frame is None:
                return
            spent.append(used["cpu"])
            yield frame.texture

    motion = Motion(patch=patch)
    moving = timed(animate(exemplar, size, FLOWS[flow], options.frames, motion=motion))
    still = next(moving)
    field = field_at(FLOWS[flow], 0, size)

    def again():
        yield still
        yield from moving

    stock = stock_of([still], None, size)
    half = stock.shifted[0][2 * stock.steps + 2]
    apart = half - warp(still, torch.full((2, *size), 0.5).to(still)).clamp(0, 1)
    row = {"still": quality(still, exemplar, still), "moved": metrics.nn(half, exemplar)}
    row["least"] = float(apart[:, 4:-4, 4:-4].square().mean().sqrt())
    ways = (
        ("ours", again()),
        ("warp", warped_frames(still, FLOWS[flow], options.frames)),
        ("regenerated", regenerated_frames(still, FLOWS[flow], options.frames)),
    )
    strips = []
    for name, images in ways:
        row[name], shown = followed(images, field, exemplar, still, options.frames)
        strips.append(torch.cat(shown, 2))
    if options.pictures:
        save(options.pictures / f"{file}.png", torch.cat(strips, 1))
    row["frames"] = options.frames
    row["cpu"] = sorted(spent[1:])[len(spent) // 2]
    return row


def memory(frames):
    """Peak MB of a process of its own, as Linux tells; `getrusage` would count its parent too."""
    script = (
        "import torch; torch.set_num_threads(1)\n"
        "from torchtex.flow.formulas import Source\n"
        "from torchtex.recipes.animate import animate\n"
        "z = torch.rand(3, 96, 96, generator=torch.Generator().manual_seed(0))\n"
        f"for frame in animate(z, (128, 128), Source(1.5), {frames}): pass\n"
        "status = open('/proc/self/status').read()\n"
        "print(float(status.split('VmHWM:')[1].split()[0]) / 1024)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    return float(done.stdout)


def loops(photo):
    """A tile that slides and comes back: the step around the loop over those within, seams."""
    frames = [
        frame.texture
        for frame in animate(
            crop(photo, 128), (128, 128), Uniform((0.0, 2.0)), 24, boundary="periodic", loop=12
        )
    ]
    steps = [
        float((one.roll(2, 2) - two).square().mean().sqrt())
        for one, two in zip(frames, [*frames[1:], frames[0]], strict=True)
    ]
    inside = steps[:-1]
    return {
        "around": steps[-1],
        "within": sum(inside) / len(inside),
        "largest": max(inside),
        "seam": [metrics.seam(frame) for frame in (frames[0], frames[11], frames[-1])],
    }


def table(report):
    """The JSON as Markdown."""
    lines = [
        "# Textures along flows",
        "",
        "| exemplar, flow | way | error | pops | nn first | nn last | tail last | swd last | "
        "sharp first | sharp last | fresh |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for key, row in report["rows"].items():
        name = ", ".join(key.split("/")[:2]) + f", {row['frames']} frames"
        still = row["still"]
        lines.append(
            f"| {name} | still | {row['least']:.4f} moved | | "
            f"{still['nn']:.3f} ({row['moved']:.3f} moved) | | "
            f"{still['tail']:.3f} | {still['swd']:.3f} | 1 | 1 | |"
        )
        for way in ("ours", "warp", "regenerated"):
            got = row[way]
            first, last = got["first"], got["last"]
            lines.append(
                f"| | {way} | {got['error']:.4f} | {100 * got['pops']:.2f} % | {first['nn']:.3f} | "
                f"{last['nn']:.3f} | {last['tail']:.3f} | {last['swd']:.3f} | "
                f"{first['sharp']:.2f} | {last['sharp']:.2f} | {got['fresh']:.2f} |"
            )
    spent = ", ".join(f"{key} {row['cpu']:.2f}" for key, row in report["rows"].items())
    lines += ["", f"CPU seconds per frame after the first: {spent}."]
    if "memory" in report:
        few, many = report["memory"]
        lines += ["", f"Peak memory of 20 and of 120 frames: {few:.0f} and {many:.0f} MB."]
    for name, got in report.get("loops", {}).items():
        steps = f"{got['around']:.4f} from the last frame to the first, {got['within']:.4f}"
        seams = ", ".join(f"{seam:.2f}" for seam in got["seam"])
        largest = f"between others (at most {got['largest']:.4f})"
        lines += ["", f"Loop of {name}: {steps} {largest}; seam {seams}."]
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    common.add_arguments(parser, threads=1)
    parser.add_argument("--runs", default=",".join(RUNS), help="exemplar/flow/patch, ...")
    parser.add_argument("--frames", type=int, default=121)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--pictures", type=common.Path, help="folder for strips of frames")
    parser.add_argument("--extras", action="store_true", help="memory and loops, too")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    photos, file = common.photos_of(options), options.out / "flow.json"
    report = json.loads(file.read_text()) if file.exists() else {"rows": {}}
    report["environment"] = common.environment(options.threads)

    def write():
        file.write_text(json.dumps(report, indent=1) + "\n")
        (options.out / "flow.md").write_text(table(report))

    for key in options.runs.split(",") if options.runs else ():
        name, flow, patch = key.split("/")
        row = one(photos[name], flow, int(patch), options, key.replace("/", "_"))
        report["rows"][key] = row
        write()
        print(key, json.dumps(row), flush=True)
    if options.extras:
        report["loops"] = {name: loops(photos[name]) for name in ("olives", "gravel_gray")}
        write()
        report["memory"] = [memory(20), memory(120)]
        write()
    print("peak MB", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


if __name__ == "__main__":
    main()
