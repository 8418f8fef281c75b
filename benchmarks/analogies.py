"""Constrained synthesis, all methods on the same pairs: time, memory, energies, looks.

    python benchmarks/analogies.py

Each folder of `--pairs` holds source.png, mapped.png and constraint.png. Every method runs in a
process of its own, one after another, on one thread unless `--threads` says otherwise; time and
memory are those of its call alone. K and N are those that `cms` recommends for the kind of pair,
which its name begins with, and the same for all methods: `cms` and `random` minimise the
energy of these K and N, and that of the labels of the others is counted with them. `random` has
as many seconds of the processor as `cms` took, which therefore runs first.

`apart` is the root mean square of mapped output minus constraint. `em` averages copies: its apart
is that of the averages, its energies are those of the copy that weighs most in each pixel.

`paper` is `cms` in the paper's way. These two and `random` share the engine of expansion moves,
and their energy is followed as they run; what it takes to look at the clock and the picture every
few moves is part of the time. The metrics see the middle of an output, for the sake of time, and
all of the source. And `cms` is run again with few moves, and with twice as many each time, till
its output is as near to the constraint as that of `quilt`: so much quicker it is, agreement no
worse.

Detail: the stream's constraint is reduced by 4 and enlarged again; and a part of a photo by 10,
with another part as the sample. Targets: reduced again within 2 % of the small picture, sharpness
at least 0.8 of the sample's, spectrum nearer to the sample's than that of bicubic enlargement.

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
from torchtex.recipes.detail import (
    back_projected,
    detail_error,
    detail_problem,
    sharpness_ratio,
    shrunk,
)
from torchtex.recipes.image_analogies import image_analogies
from torchtex.recipes.montage import Stage
from torchtex.recipes.rivals import (
    constrained_quilting,
    guided,
    labeling_of,
    random_placement,
)
from torchtex.recipes.transfers import luminance_matched

PARTS = ("near", "detail")
SEEN = 128  # pixels a side, of the middle of an output, that the metrics see
TIMES = (1, 2, 3, 5, 7, 10, 15, 20, 30)
METHODS = ("cms", "paper", "analogies", "quilt", "random", "em")
LOWERING = ("cms", "paper", "random")  # methods that minimise the energy of K and N
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
    "artistic_filter": Settings(0.5, 3, turns=False, match=True),
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


def made(method: str, problem: Analogy, use: Settings, seconds: float, curve: list):
    """What a method returns: texture, labeling, and how to render the mapped output."""
    begun = time.process_time()

    def look(stage: Stage) -> None:
        if stage.note == "improving":
            curve.append((time.process_time() - begun, float(stage.detail.split()[1].strip(","))))

    if method in LOWERING:
        options = {"K": use.K, "N": use.N, "turns": use.turns, "on_step": look}
        if method == "random":
            result = random_placement(problem, seconds=seconds, **options)
        else:
            result = cms(problem, screened=method == "cms", **options)
        curve.append((time.process_time() - begun, result.energies.minimised))
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
    curve: list[tuple[float, float]] = []
    texture, labeling, apply = made(method, problem, use, seconds, curve)
    row = {"pair": folder.name, "method": method, "seconds": time.perf_counter() - start,
           "cpu": time.process_time() - cpu, "idle_mib": idle}  # fmt: skip
    row["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if method != "em":
        assert torch.equal(apply(problem.sources[0]), texture)
    paid = energy(problem, labeling, K=use.K, N=use.N)
    row |= {"settings": asdict(use), "energy": paid.minimised} | asdict(paid)
    row["apart"] = gap_of(problem, apply)
    some = [*curve[: -1 : max(1, len(curve) // 200)], *curve[-1:]]
    row["curve"] = [(round(spent, 3), float(f"{value:.5g}")) for spent, value in some]
    row["metrics"] = metrics.battery(middle(texture), problem.sources[0])
    images.save(out / f"{folder.name}_{method}.png", texture)
    return row


def middle(picture):
    """The middle of a picture."""
    top, left = (max(n - SEEN, 0) // 2 for n in picture.shape[1:])
    return picture[:, top : top + SEEN, left : left + SEEN].contiguous()


def as_near(folder: Path, wanted: float) -> dict:
    """How long `cms` takes till `apart` is as wanted: runs of ever more moves."""
    problem, use = problem_of(folder), settings_of(folder.name)
    moves = 25
    while True:
        cpu = time.process_time()
        result = cms(problem, K=use.K, N=use.N, turns=use.turns, max_moves=moves)
        cpu = time.process_time() - cpu
        found = gap_of(problem, result.montage.apply)
        if found <= wanted or len(result.moves) < moves:
            return {"moves": len(result.moves), "cpu": cpu, "apart": found, "wanted": wanted}
        moves *= 2


def gap_of(problem: Analogy, apply) -> float:
    """Root mean square of mapped output minus constraint."""
    gap = apply(problem.mapped[0][0]) - problem.constraints[0]
    return float(gap.square().sum(0).mean().sqrt())


def detailed(out: Path, name: str, sample, low, factor: int, K: float) -> dict:
    """Detail synthesis of one small picture, before and after back projection, and bicubic."""
    problem = detail_problem(sample, low, factor)
    cpu = time.process_time()
    raw = cms(problem, K=K, N=2, turns=False, tolerance=5 * (K + 2)).texture
    cpu = time.process_time() - cpu
    pictures = {"raw": raw, "back projected": back_projected(raw, low, factor),
                "bicubic": problem.constraints[0]}  # fmt: skip
    row = {"name": name, "factor": factor, "K": K, "cpu": cpu, "size": list(problem.size)}
    for kind, picture in pictures.items():
        row[kind] = {"off": detail_error(picture, low, factor),
                     "sharpness": sharpness_ratio(picture, sample),
                     "spec": metrics.spec(picture, sample)}  # fmt: skip
        images.save(out / f"detail_{name}_{kind.split()[0]}.png", picture)
    return row


def details(pairs: Path, out: Path) -> list[dict]:
    """The stream by 4, and gravel by 10."""
    stream = pairs / "super_resolution_stream"
    whole = load(stream / "constraint.png")
    low = shrunk(whole, (whole.shape[1] // 4, whole.shape[2] // 4))
    rows = [detailed(out, "stream", load(stream / "source.png"), low, 4, 20.0)]
    photo = load(SHARED / "gravel_gray.png")
    half = photo.shape[2] // 2
    low = shrunk(photo[:, :250, half : half + 120].contiguous(), (25, 12))
    return [*rows, detailed(out, "gravel", photo[:, :, :half].contiguous(), low, 10, 20.0)]


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
    text += [table(head, verdicts), *curve_tables(report), *near_table(report)]
    return "\n\n".join([*text, *detail_table(report)]) + "\n"


def at_time(curve: list, seconds: float) -> str:
    """E' at a time; nothing before all is covered, or when it had ended."""
    before = [value for spent, value in curve if spent <= seconds]
    return f"{before[-1]:.4g}" if before and seconds <= curve[-1][0] else ""


def curve_tables(report: dict) -> list[str]:
    """E' against seconds of the processor."""
    rows = []
    for row in report["rows"]:
        if row["curve"]:
            curve = row["curve"]
            ended = f"{curve[-1][1]:.4g} at {curve[-1][0]:.1f} s"
            rows.append((row["pair"], row["method"], *(at_time(curve, t) for t in TIMES), ended))
    return ["E' at seconds of the processor.",
            table(("pair", "method", *(f"{t} s" for t in TIMES), "end"), rows)]  # fmt: skip


def near_table(report: dict) -> list[str]:
    """How much sooner than quilting cms is as near to the constraint."""
    rows = []
    quilts = {row["pair"]: row for row in report["rows"] if row["method"] == "quilt"}
    for pair, near in report.get("near", {}).items():
        ratio = quilts[pair]["cpu"] / near["cpu"]
        met = near["apart"] <= near["wanted"]
        verdict = "not as near" if not met else "met" if ratio >= WANTED["quilt"] else "not met"
        rows.append((pair, str(near["moves"]), f"{near['cpu']:.1f}", f"{near['apart']:.3f}",
                     f"{near['wanted']:.3f}", f"{ratio:.1f}", verdict))  # fmt: skip
    head = ("pair", "moves", "CPU s", "apart", "apart of quilt", "times quicker", "target 14")
    return ["cms with no more moves than make it as near as quilt.", table(head, rows)]


def detail_table(report: dict) -> list[str]:
    """Detail synthesis against its targets."""
    rows = []
    for row in report.get("detail", []):
        for kind in ("raw", "back projected", "bicubic"):
            found = row[kind]
            rows.append((row["name"], f"{row['factor']}", f"{row['size'][0]}x{row['size'][1]}",
                         f"{row['cpu']:.1f}" if kind == "raw" else "", kind,
                         f"{100 * found['off']:.2f}", f"{found['sharpness']:.2f}",
                         f"{found['spec']:.3f}"))  # fmt: skip
    head = ("picture", "factor", "size", "CPU s", "output", "% off", "sharpness", "spec")
    return ["Detail, K 20, N 2, the tolerance of the paper.", table(head, rows)]


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
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=METHODS)
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=PARTS,
                        help="what to measure besides the table of methods")  # fmt: skip
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
        more(report, folder, options)
        file.write_text(json.dumps(report, indent=1))
        file.with_suffix(".md").write_text(page(report))
    if "detail" in options.parts:
        report["detail"] = details(options.pairs, pictures)
    file.write_text(json.dumps(report, indent=1))
    file.with_suffix(".md").write_text(page(report))


def more(report: dict, folder: Path, options: argparse.Namespace) -> None:
    """The parts of the report that are about one pair and not one method."""
    found = {row["method"]: row for row in report["rows"] if row["pair"] == folder.name}
    curves = {name: row["curve"] for name, row in found.items() if row["curve"]}
    draw_curves(curves, options.out / "analogies" / f"curve_{folder.name}.png")
    if "near" in options.parts and "quilt" in found:
        near = as_near(folder, found["quilt"]["apart"])
        report.setdefault("near", {})[folder.name] = near
        print(f"{folder.name} as near as quilt: {near}", flush=True)


def draw_curves(curves: dict, path: Path) -> None:
    """E' against seconds, as a picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    for name, curve in curves.items():
        axes.plot([t for t, _ in curve], [e for _, e in curve], label=name)
    axes.set(yscale="log", xlabel="seconds of the processor", ylabel="E'")
    axes.legend()
    figure.savefig(path)


if __name__ == "__main__":
    main()
