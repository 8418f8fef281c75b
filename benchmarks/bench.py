"""Speed, memory and quality of the core, as JSON and a table.

Sections: `mstep` (exact against fast search), `estep`, `runs` (whole syntheses: time, peak memory,
energy), `features` (the battery per feature and exemplar), `growth` (time and memory against
output pixels). Whole runs each have a process of their own, so that peak memory is theirs.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import torch
from common import add_arguments, environment, measured, photo_files, photos_of, timed
from exemplars import crop, load
from tables import render

import torchtex
from torchtex import metrics

FEATURES = {
    "pixels": torchtex.Pixels(),
    "gradients": torchtex.Gradients(),
    "haar": torchtex.Wavelets("haar"),
    "db2": torchtex.Wavelets("db2"),
    "db4": torchtex.Wavelets("db4"),
}


def synthesized(exemplar, size, **options):
    """A synthesis and its CPU seconds."""
    start = time.process_time()
    result = torchtex.synthesize(exemplar, (size, size), **options)
    return result, time.process_time() - start


def mstep(photos, repeats):
    """One M-step, exact and fast, on the texture that a synthesis begins its finest level with."""
    rows = []
    for name, photo in list(photos.items())[:4]:
        for extent, size in ((128, 32), (128, 16), (128, 8), (256, 8)):
            z = crop(photo, extent)
            if min(z.shape[1:]) < extent:
                continue
            grid = torchtex.Grid(2 * extent, 2 * extent, size, size // 4)
            x = torchtex.synthesize(z, (2 * extent, 2 * extent)).texture
            row = {"exemplar": name, "extent": extent, "window": size}
            labels = None
            for key, search in (
                ("exact", torchtex.exact_search()),
                ("fast", torchtex.fast_search()),
            ):
                model = torchtex.texture_model([z], grid, search=search)
                labels = model.match(x) if labels is None else labels
                first = labels

                def step(model=model, x=x, first=first):
                    return model.match(x, first)

                row[key] = timed(step, repeats if extent == 128 else 1)
            row["ratio"] = row["exact"]["cpu"] / row["fast"]["cpu"]
            rows.append(row)
            print(f"mstep {name} {extent} w={size}: fast is {row['ratio']:.1f}x", flush=True)
    return rows


def energies(photos):
    """Whole runs with the exact and the fast search: final energy and M-step seconds."""
    rows = []
    for name, photo in photos.items():
        z = crop(photo, 128)
        row = {"exemplar": name}
        for key, search in (("exact", torchtex.exact_search()), ("fast", torchtex.fast_search())):
            result, cpu = synthesized(z, 256, search=search)
            row[key] = {"energy": result.energies[-1], "seconds": result.seconds, "cpu": cpu}
        row["excess"] = row["fast"]["energy"] / row["exact"]["energy"] - 1
        rows.append(row)
        print(f"energy {name}: fast is {100 * row['excess']:+.2f} % of exact", flush=True)
    return rows


def estep(photos, repeats):
    """One E-step per feature and solver."""
    name, photo = next(iter(photos.items()))
    z = crop(photo, 128)
    x = torchtex.synthesize(z, (256, 256)).texture
    grid = torchtex.Grid(256, 256, 8, 2)
    rows = []
    for key, feature in FEATURES.items():
        model = torchtex.texture_model([z], grid, feature=feature)
        objective = torchtex.Objective(((1.0, model.energy(model.match(x))),))
        before = float(objective(x))
        for solver in (torchtex.ClosedForm(), torchtex.Descend("lbfgs"), torchtex.Descend("adam")):
            row = {"exemplar": name, "feature": key, "solver": repr(solver)}

            def solve(solver=solver, objective=objective):
                return solver(objective, x)

            row["seconds"] = timed(solve, repeats)
            row["energy"] = float(objective(solver(objective, x))) / before
            rows.append(row)
            print(f"estep {key} {repr(solver)[:18]} {row['seconds']['median']:.3f} s", flush=True)
    return rows


def features(photos, seeds):
    """The battery of each feature on each exemplar, and of the algorithm of the paper."""
    rows = []
    for name, photo in photos.items():
        z = crop(photo, 128)
        for key, feature in FEATURES.items():
            for seed in range(seeds):
                result, cpu = synthesized(z, 256, feature=feature, seed=seed)
                numbers = metrics.battery(result.texture, z)
                rows.append(
                    {
                        "exemplar": name,
                        "feature": key,
                        "seed": seed,
                        "seconds": result.seconds,
                        "cpu": cpu,
                        "energy": result.energies[-1],
                        "metrics": numbers,
                    }
                )
        print(f"features {name}", flush=True)
    return rows


def whole(path, extent, size, threads):
    """One synthesis in a process of its own: seconds, and peak memory in MiB."""
    command = [sys.executable, __file__, "--child", path, str(extent), str(size), str(threads)]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return json.loads(out.splitlines()[-1])


def child(path, extent, size, threads):
    """The work of `whole`: the process's imports are done and measured before it begins."""
    torch.set_num_threads(int(threads))
    z = crop(load(Path(path)), int(extent))
    torchtex.synthesize(z[:, :48, :48], (48, 48))  # loads what is loaded lazily
    idle = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    result, cpu = synthesized(z, int(size))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    report = {"seconds": result.seconds, "cpu": cpu, "peak_mib": peak, "idle_mib": idle}
    print(json.dumps(report | {"energy": result.energies[-1]}))


def runs(files, threads):
    """128 -> 256, 256 -> 512 and 256 -> 1024 on every exemplar that is large enough."""
    rows = []
    for path in files:
        shape = load(Path(path)).shape
        large = [(256, 512), (256, 1024)] if min(shape[1:]) >= 256 else []
        cases = [(128, 256), *large]
        for extent, size in cases:
            row = {"exemplar": path.stem, "extent": extent, "size": size}
            rows.append({**row, **whole(str(path), extent, size, threads)})
            print(f"runs {path.stem} {extent} -> {size}: {rows[-1]['seconds']:.2f} s", flush=True)
    return rows


def growth(files, threads):
    """One exemplar of 256 px to 512, 1024 and 2048."""
    large = [path for path in files if _side(path) >= 256]
    path = str((large or files)[0])
    rows = []
    for size in (512, 1024, 2048):
        rows.append({"size": size, **whole(path, 256, size, threads)})
        print(f"growth {size}: {rows[-1]}", flush=True)
    return rows


def _side(path):
    return min(load(Path(path)).shape[1:])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(
        parser, threads=2, repeats=3, sections="mstep,energies,estep,runs,growth,features"
    )
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        return child(*options.child)
    torch.set_num_threads(options.threads)
    photos, files = photos_of(options), photo_files(options)
    sections = {
        "mstep": lambda: mstep(photos, options.repeats),
        "energies": lambda: energies(photos),
        "estep": lambda: estep(photos, options.repeats),
        "runs": lambda: runs(files, options.threads),
        "growth": lambda: growth(files, options.threads),
        "features": lambda: features(photos, options.seeds),
    }
    file = options.out / "bench.json"
    measured(
        file,
        {"environment": environment(options.threads, "faiss-cpu")},
        sections,
        options.sections,
        lambda report: file.with_suffix(".md").write_text(render(report)),
    )
    return None


if __name__ == "__main__":
    main()
