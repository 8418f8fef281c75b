"""Constrained synthesis, five methods on the same pairs: time, memory, energies, looks.

    python benchmarks/analogies.py

Each folder of `--pairs` holds source.png, mapped.png and constraint.png. Every method runs in a
process of its own, one after another, on one thread unless `--threads` says otherwise; time and
memory are those of its call alone. K and N are those that `cms` recommends for the kind of pair,
which its name begins with, and the same for all methods: `cms` and `random` minimise the
energy of these K and N, and that of the labels of the others is counted with them. `random` has
as many seconds of the processor as `cms` took, which therefore runs first.

`apart` is the root mean square of mapped output minus constraint. `em` averages copies: its apart
is that of the averages, its energies are those of the copy that weighs most in each pixel.

Results are merged into analogies.json, so `--only` and `--methods` measure a part again. The
pictures, and a sheet for each pair, go to analogies/ beside it, which git ignores.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import torch
from common import commit
from exemplars import SHARED, load
from PIL import Image, ImageDraw, ImageFont
from tables import table

from torchtex import image as images
from torchtex import metrics
from torchtex.recipes.analogy import Analogy
from torchtex.recipes.analogy_costs import energy
from torchtex.recipes.cms import cms
from torchtex.recipes.image_analogies import image_analogies
from torchtex.recipes.rivals import (
    constrained_quilting,
    guided,
    labeling_of,
    random_placement,
)
from torchtex.recipes.transfers import luminance_matched

METHODS = ("cms", "analogies", "quilt", "random", "em")
WANTED = {"analogies": 5, "quilt": 14}  # times as long as cms, in the paper, at least
GAP, LINE = 8, 18


@dataclass(frozen=True)
class Settings:
    """Of one kind of pair."""

    K: float
    N: int
    kappa: float = 1.0
    turns: bool = True
    match: bool = False


KINDS = {
    "texture_by_numbers": Settings(0.05, 3, kappa=5.0, turns=False),
    "super_resolution": Settings(10.0, 2, turns=False),
    "texture_transfer": Settings(4.0, 2),
    "artistic_filter": Settings(2.0, 2, turns=False, match=True),
    "": Settings(1.0, 3, kappa=2.0),
}


def settings_of(name: str) -> Settings:
    """By the beginning of the name of a pair."""
    return next(value for kind, value in KINDS.items() if name.startswith(kind))


def problem_of(folder: Path) -> Analogy:
    """The analogy in a folder; the source's lightness is matched where the kind asks for it."""
    names = ("source", "mapped", "constraint")
    source, mapped, constraint = (load(folder / f"{name}.png") for name in names)
    problem = Analogy.of(source, mapped, constraint)
    return luminance_matched(problem) if settings_of(folder.name).match else problem


def made(method: str, problem: Analogy, use: Settings, seconds: float):
    """What a method returns: texture, labeling, and how to render the mapped output."""
    if method in ("cms", "random"):
        if method == "cms":
            result = cms(problem, K=use.K, N=use.N, turns=use.turns)
        else:
            result = random_placement(problem, K=use.K, N=use.N, turns=use.turns, seconds=seconds)
        return result.texture, result.labeling, result.montage.apply
    if method == "analogies":
        result = image_analogies(problem, kappa=use.kappa)
    elif method == "quilt":
        result = constrained_quilting(problem)
    else:
        result = guided(problem)
    return result.texture, labeling_of(problem, result.source_map), result.apply


def measure(method: str, folder: Path, out: Path, seconds: float) -> dict:
    """One run, in this process: all that is loaded and the pictures are not counted."""
    import faiss  # noqa: F401
    import maxflow  # noqa: F401

    problem, use = problem_of(folder), settings_of(folder.name)
    idle = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    start, cpu = time.perf_counter(), time.process_time()
    texture, labeling, apply = made(method, problem, use, seconds)
    row = {"pair": folder.name, "method": method, "seconds": time.perf_counter() - start,
           "cpu": time.process_time() - cpu, "idle_mib": idle}  # fmt: skip
    row["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if method != "em":
        assert torch.equal(apply(problem.sources[0]), texture)
    paid = energy(problem, labeling, K=use.K, N=use.N)
    row |= {"settings": asdict(use), "energy": paid.minimised} | asdict(paid)
    gap = apply(problem.mapped[0][0]) - problem.constraints[0]
    row["apart"] = float(gap.square().sum(0).mean().sqrt())
    row["metrics"] = metrics.battery(texture, problem.sources[0])
    images.save(out / f"{folder.name}_{method}.png", texture)
    return row


def run(method: str, folder: Path, options: argparse.Namespace, seconds: float) -> dict:
    """The same in a process of its own."""
    command = [
        sys.executable, __file__, "--one", method, "--pairs", str(folder), "--seconds",
        str(seconds), "--threads", str(options.threads), "--out", str(options.out),
    ]  # fmt: skip
    environment = os.environ | {"OMP_NUM_THREADS": str(options.threads),
                                "OMP_WAIT_POLICY": "PASSIVE"}  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        raise SystemExit(f"{method} on {folder.name} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def ratios(rows: list[dict]) -> list[dict]:
    """Every method against cms, pair by pair: time, and how far O_Q is from the constraint."""
    found = []
    base = {row["pair"]: row for row in rows if row["method"] == "cms"}
    for row in rows:
        ours = base.get(row["pair"])
        if ours is not None and row is not ours:
            ratio = {"pair": row["pair"], "method": row["method"]}
            ratio |= {"time": row["cpu"] / ours["cpu"], "apart": row["apart"] / ours["apart"]}
            ratio |= {key: row[key] / ours[key] for key in ("energy", "agreement", "boundary")}
            found.append(ratio)
    return found


def page(report: dict) -> str:
    """The report as Markdown."""
    shown = ("tail", "miss", "swd", "copy", "repeat")
    lines = [
        (row["pair"], row["method"], f"{row['cpu']:.1f}", f"{row['seconds']:.1f}",
         f"{row['peak_mib']:.0f}", f"{row['energy']:.4g}", f"{row['agreement']:.4g}",
         f"{row['boundary']:.4g}", f"{row['apart']:.3f}",
         *(f"{row['metrics'][name]:.3f}" for name in shown))
        for row in report["rows"]
    ]  # fmt: skip
    head = ("pair", "method", "CPU s", "seconds", "MiB", "E'", "A", "B", "apart", *shown)
    about = ", ".join(f"{key} {value}" for key, value in report["environment"].items())
    text = ["# Constrained synthesis", about, table(head, lines)]
    verdicts = []
    for ratio in report["ratios"]:
        wanted = WANTED.get(ratio["method"])
        verdict = "" if wanted is None else f"wanted {wanted}: " + (
            "met" if ratio["time"] >= wanted and ratio["apart"] >= 1 else "not met")  # fmt: skip
        verdicts.append(
            (ratio["pair"], ratio["method"], f"{ratio['time']:.2f}", f"{ratio['apart']:.2f}",
             f"{ratio['energy']:.2f}", f"{ratio['agreement']:.2f}", f"{ratio['boundary']:.2f}",
             verdict)
        )  # fmt: skip
    text.append("Each method over cms; above 1, cms is quicker, closer, or cheaper. A target is "
                "met if cms is as much quicker and `apart` no worse.")  # fmt: skip
    head = ("pair", "method", "CPU time", "apart", "E'", "A", "B", "target")
    return "\n\n".join([*text, table(head, verdicts)]) + "\n"


def sheet(folder: Path, pictures: Path) -> Image.Image:
    """The three inputs above, and what the methods made of them, pixel for pixel."""
    inputs = [(name, folder / f"{name}.png") for name in ("source", "mapped", "constraint")]
    outputs = [(name, pictures / f"{folder.name}_{name}.png") for name in METHODS]
    rows = [inputs, outputs[:3], outputs[3:]]
    opened = [[(n, Image.open(p).convert("RGB")) for n, p in row if p.exists()] for row in rows]
    width = max(sum(p.width + GAP for _, p in row) for row in opened) + GAP
    heights = [max((p.height for _, p in row), default=0) + LINE + GAP for row in opened]
    whole = Image.new("RGB", (width, sum(heights)), "white")
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(size=12)
    for i, row in enumerate(opened):
        top, left = sum(heights[:i]), GAP
        for name, picture in row:
            draw.text((left, top + 2), name, (20, 20, 20), font)
            whole.paste(picture, (left, top + LINE))
            left += picture.width + GAP
    return whole


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=Path, default=SHARED / "pairs", metavar="DIR",
                        help="folder of folders with source, mapped and constraint")  # fmt: skip
    parser.add_argument("--out", default=Path(__file__).parent / "results", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--only", nargs="+", metavar="PAIR", help="pairs to run (default: all)")
    parser.add_argument("--one", choices=METHODS, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, default=0, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    options = parse()
    torch.set_num_threads(options.threads)
    pictures = options.out / "analogies"
    if options.one:
        print(json.dumps(measure(options.one, options.pairs, pictures, options.seconds)))
        return
    folders = [p.parent for p in sorted(options.pairs.glob("*/mapped.png"))]
    if not folders:
        raise SystemExit(f"--pairs {options.pairs} holds no folder with mapped.png; name another")
    folders = [f for f in folders if options.only is None or f.name in options.only]
    pictures.mkdir(parents=True, exist_ok=True)
    file = options.out / "analogies.json"
    report = json.loads(file.read_text()) if file.exists() else {"rows": []}
    report["environment"] = {
        "torch": torch.__version__, "faiss": version("faiss-cpu"),
        "PyMaxflow": version("PyMaxflow"), "python": platform.python_version(),
        "cores": os.cpu_count(), "threads": options.threads, "device": "cpu", "commit": commit(),
    }  # fmt: skip
    rows = {(row["pair"], row["method"]): row for row in report["rows"]}
    for folder in folders:
        for method in (m for m in METHODS if m in options.methods):
            budget = rows.get((folder.name, "cms"), {}).get("cpu", 0)
            row = rows[folder.name, method] = run(method, folder, options, budget)
            print(f"{folder.name} {method}: {row['cpu']:.1f} s, E' {row['energy']:.4g}", flush=True)
            order = sorted(rows, key=lambda key: (key[0], METHODS.index(key[1])))
            report["rows"] = [rows[key] for key in order]
            report["ratios"] = ratios(report["rows"])
            file.write_text(json.dumps(report, indent=1))
            file.with_suffix(".md").write_text(page(report))
        sheet(folder, pictures).save(pictures / f"sheet_{folder.name}.png")


if __name__ == "__main__":
    main()
