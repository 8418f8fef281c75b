"""Solids: slices against the exemplar and against 2D synthesis, time, memory; JSON and a table.

Sections: `slices` and `large`.

`slices` makes a 64^3 solid of each photo, cropped to 128 px, by `solid` and by `skeletal_solid`,
and a 64 x 64 texture by `synthesize`. `nn`, `tail` and `swd` are means over slices across the axes
that are prescribed, `diagonal ...` over planes at 45 degrees along an axis that is; `over 2d` is
over that of `synthesize`, and `over real` over that of a part of the photo that is not in the
exemplar, of the same size, where the photo is large enough. `emd` is the earth mover's distance
between the values of the volume and of the exemplar, of the worst channel; `seam` the steps across
the worst pair of faces over the mean of those inside, `most inside` the largest of those inside
over it, and `larger` the share of planes inside whose step is larger than that of the faces.
Photos with a grain or courses (`SIDED`) prescribe the side views alone.

`large` makes one 128^3 solid each way, each in a process of its own that tells its peak memory.
"""

import argparse
import json
import resource
import statistics
import subprocess
import sys

import torch
from common import add_arguments, environment, measured, once, photo_files
from exemplars import crop, load, remainder

import torchtex
from torchtex import metrics
from torchtex.recipes.skeletal_solid import skeletal_solid
from torchtex.recipes.solid import solid
from torchtex.volumes.histograms import earth_mover
from torchtex.volumes.slices import diagonal_slice, slices_of

NAMES = "granite_speckled,olives,wood_beech,brick_tan,marble_pink"
SIDED = ("wood_beech", "brick_tan", "bricks", "wood")
SIDE = 128
EXTENT = (64, 64, 64)
PLACES = (3, 24, 45)
WAYS = {"kopf": solid, "skeletal": skeletal_solid}
COLUMNS = (
    "cpu", "seconds", "nn", "tail", "swd", "diagonal nn", "diagonal tail", "emd", "seam",
    "most inside", "larger",
    "nn over 2d", "tail over 2d", "nn over real", "tail over real", "diagonal tail over real",
)  # fmt: skip


def judged(pictures, exemplar):
    """Means over pictures."""
    pictures = [picture.contiguous() for picture in pictures]
    return {
        measure.__name__: statistics.fmean(measure(picture, exemplar) for picture in pictures)
        for measure in (metrics.nn, metrics.tail, metrics.swd)
    }


def faces_of(volume):
    """Steps across the faces, of the worst axis, and the largest inside, over the mean inside.

    Planes inside differ too: `larger` is the share of them, over all axes, whose step is larger
    than that across the face; a half where faces are planes like others.
    """
    worst, most, larger = [], [], []
    for dim in (1, 2, 3):
        steps = (volume - volume.roll(1, dim)).abs().movedim(dim, 0).flatten(1).mean(1)
        inside = steps[1:]
        worst.append(float(steps[0] / inside.mean()))
        most.append(float(inside.max() / inside.mean()))
        larger.append(float((inside > steps[0]).double().mean()))
    return {"seam": max(worst), "most inside": max(most), "larger": statistics.fmean(larger)}


def looks(made, exemplar, axes):
    """All that is measured of a volume."""
    cut = [slices_of(made.volume, axis)[place] for axis in axes for place in PLACES]
    diagonal = [diagonal_slice(made.volume, axis, place) for axis in (1,) for place in PLACES]
    found = judged(cut, exemplar)
    found |= {f"diagonal {name}": value for name, value in judged(diagonal, exemplar).items()}
    found["emd"] = float(earth_mover(made.volume, exemplar).max())
    return found | faces_of(made.volume)


def ratio(one, other):
    """None where the other is a copy of the exemplar, which no ratio says anything about."""
    return None if other < 1e-4 else one / other


def shown(number, digits):
    """A number for the table."""
    return "-" if number is None else f"{number:.{digits}f}"


def given(name, exemplar):
    """What a photo prescribes, and the axes it is measured on."""
    sided = name in SIDED
    return ([exemplar, None, exemplar], (0, 2)) if sided else (exemplar, (0, 1, 2))


def slice_rows(photos):
    """One row for each photo and way."""
    rows = []
    for name, photo in photos.items():
        exemplar = crop(photo, SIDE)
        flat, _ = once(torchtex.synthesize, exemplar, (64, 64))
        plain = judged([flat.texture], exemplar)
        rest = remainder(photo, SIDE)
        real = judged([part[:, :64, :64] for part in rest], exemplar) if rest else None
        for way, recipe in WAYS.items():
            exemplars, axes = given(name, exemplar)
            made, spent = once(recipe, exemplars, EXTENT)
            row = {"exemplar": name, "way": way} | spent | looks(made, exemplar, axes)
            for key in ("nn", "tail", "diagonal nn", "diagonal tail"):
                bare = key.split()[-1]
                row[f"{key} over 2d"] = ratio(row[key], plain[bare])
                row[f"{key} over real"] = None if real is None else ratio(row[key], real[bare])
            rows.append(row)
            print(name, way, *(f"{key} {shown(row[key], 3)}" for key in COLUMNS), flush=True)
    return rows


def large_rows(photos, threads):
    """A large solid each way, in a process of its own."""
    rows = []
    path = next(iter(photos))
    for way in WAYS:
        line = [sys.executable, __file__, "--worker", way, "--photo", path, "--threads", threads]
        done = subprocess.run([str(part) for part in line], capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stderr)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(rows[-1], flush=True)
    return rows


def worker(way, path, extent):
    """Makes one solid, and tells how long it took and how much memory."""
    exemplar = crop(load(path), SIDE)
    made, spent = once(WAYS[way], exemplar, (extent,) * 3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    row = {"way": way, "extent": extent, "MiB": peak} | spent
    row |= {"emd": float(earth_mover(made.volume, exemplar).max()), "way": way} | faces_of(
        made.volume
    )
    print(json.dumps(row))


def table(file, report):
    """The report as a page."""
    lines = ["# Solids", "", ", ".join(f"{k} {v}" for k, v in report["environment"].items()), ""]
    if "slices" in report:
        lines += ["| exemplar | way | " + " | ".join(COLUMNS) + " |"]
        lines += ["|" + " --- |" * (len(COLUMNS) + 2)]
        for row in report["slices"]:
            cells = [shown(row[key], 1) for key in COLUMNS[:2]]
            cells += [shown(row[key], 3) for key in COLUMNS[2:11]]
            cells += [shown(row[key], 2) for key in COLUMNS[11:]]
            lines.append("| " + " | ".join([row["exemplar"], row["way"], *cells]) + " |")
        lines += ["", "Skeletal over kopf, medians over the exemplars:"]
        ways = {way: [r for r in report["slices"] if r["way"] == way] for way in WAYS}
        for key in COLUMNS[:7]:
            pairs = zip(ways["skeletal"], ways["kopf"], strict=True)
            ratio = statistics.median(one[key] / two[key] for one, two in pairs)
            lines.append(f"{key} {ratio:.2f}")
    if "large" in report:
        lines += ["", "| way | voxels a side | CPU s | seconds | MiB | emd | seam |"]
        lines += ["|" + " --- |" * 7]
        for row in report["large"]:
            numbers = (row["cpu"], row["seconds"], row["MiB"], row["emd"], row["seam"])
            cells = " | ".join(f"{number:.4g}" for number in numbers)
            lines.append(f"| {row['way']} | {row['extent']} | {cells} |")
    file.write_text("\n".join(lines) + "\n")


def main():
    """Runs the sections."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, threads=1, sections="slices,large")
    parser.add_argument("--names", default=NAMES, help="photos, with commas between them")
    parser.add_argument("--worker", choices=list(WAYS), help=argparse.SUPPRESS)
    parser.add_argument("--photo", help=argparse.SUPPRESS)
    parser.add_argument("--extent", type=int, default=128, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.worker:
        worker(options.worker, options.photo, options.extent)
        return
    from exemplars import BUNDLED

    files = {path.stem: path for path in (*BUNDLED.glob("*.png"), *photo_files(options))}
    files = {name: files[name] for name in options.names.split(",") if name in files}
    about = {"environment": environment(options.threads, "faiss-cpu")}
    sections = {
        "slices": lambda: slice_rows({name: load(path) for name, path in files.items()}),
        "large": lambda: large_rows([str(path) for path in files.values()], options.threads),
    }
    file = options.out / "solids.json"
    measured(file, about, sections, options.sections,
             lambda report: table(file.with_suffix(".md"), report))  # fmt: skip


if __name__ == "__main__":
    main()
