"""Texture synthesis beside its peers: pictures, times, the metric battery and a verdict.

    python benchmarks/peers.py --seeds 3 --methods gmic resynthesizer torchtex real tile

Each picture is made by a process of its own, which reports the seconds and the memory that the
synthesis call added, without the start of the interpreter, the imports, the reading of files.
The peers live in a virtual environment of their own, so that their licences and versions stay
out of this one. Pictures and measurements are kept under `--out`; a rerun does what is missing
or out of date. `peers.json` has every number, `peers.md` the tables and the verdict.

This file is also the worker that runs inside the peers' environment, where there is no torch:
whatever needs torch is imported inside the functions that use it.
"""

import argparse
import hashlib
import inspect
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
SIZE = 256  # height and width of every synthesis
PACKAGES = ("gmic", "resynthesizer", "numpy", "Pillow")
METRICS = ("nn", "tail", "miss", "swd", "spec", "copy", "repeat")
PEERS = ("gmic", "resynthesizer")
OURS = ("torchtex", "paper")
RECIPES = ("quilt", "patchwise", "graphcut", "wang")
ANCHORS = ("real", "tile")
NAMES = {
    "gmic": "G'MIC",
    "resynthesizer": "Resynthesizer",
    "torchtex": "torchtex",
    "paper": "torchtex as in the paper",
    "quilt": "torchtex quilt",
    "patchwise": "torchtex patchwise",
    "graphcut": "torchtex graphcut",
    "wang": "torchtex wang",
    "real": "real, median strip",
    "real_worst": "real, worst strip",
    "tile": "tile",
}

Call = Callable[[], np.ndarray]
Taken = dict[str, float]  # what one call took: seconds, cpu_seconds, memory_mib
TAKEN = ("seconds", "cpu_seconds", "memory_mib")


# Methods: given an 8-bit (h, w, 3) exemplar, each prepares all that should not be timed and
# returns the call that should. They run in the worker.


def gmic(exemplar: np.ndarray, height: int, width: int, seed: int) -> Call:
    """G'MIC's `syntexturize_matchpatch width,height`, all else at its defaults."""
    import gmic

    interpreter = gmic.Gmic()
    images = gmic.ImageList([gmic.Image.from_yxc(exemplar.astype(np.float32))])
    command = f"srand {seed} syntexturize_matchpatch {width},{height}"

    def call() -> np.ndarray:
        return np.array(interpreter.run(command, images)[0].yxc)

    return call


def resynthesizer(exemplar: np.ndarray, height: int, width: int, seed: int) -> Call:
    """Resynthesizer's `resynthesize(image, mask)`, not asked to tile, otherwise at its defaults.

    It fills the white part of a mask from the black part. So the exemplar stands in the corner of
    a larger canvas, and the result is the rectangle beside it, which holds no pixel of the
    exemplar itself. To tile, as the package's defaults have it, would wrap that whole canvas,
    exemplar included: clearly worse results. Its random numbers always start from the same seed;
    `seed` extra columns, cut off afterwards, change their use and thereby the whole result.
    """
    from resynthesizer import getDefaultParams, resynthesize

    h, w = exemplar.shape[:2]
    canvas = np.zeros((max(h, height), w + width + seed, 3), np.uint8)
    canvas[:h, :w] = exemplar
    mask = np.full(canvas.shape[:2], 255, np.uint8)
    mask[:h, :w] = 0
    images = Image.fromarray(canvas), Image.fromarray(mask)
    parameters = getDefaultParams()
    parameters.isMakeSeamlesslyTileableHorizontally = 0
    parameters.isMakeSeamlesslyTileableVertically = 0

    def call() -> np.ndarray:
        filled = resynthesize(*images, parameters)
        return np.array(filled)[:height, w : w + width]

    return call


def torchtex(exemplar: np.ndarray, height: int, width: int, seed: int) -> Call:
    """Our own synthesis with its defaults."""
    return _torchtex(exemplar, height, width, seed)


def paper(exemplar: np.ndarray, height: int, width: int, seed: int) -> Call:
    """Our own synthesis set as in Kwatra et al. 2005.

    Nearest neighborhoods, a start from random ones, enlarged pixels between scales, 1/4 with 8
    first.
    """
    from torchtex import RandomNeighborhoods, default_schedule

    options = {
        "completeness": 0.0,
        "start": RandomNeighborhoods(),
        "carry": False,
        "schedule": default_schedule()[1:],
    }
    return _torchtex(exemplar, height, width, seed, **options)


def quilt(exemplar: np.ndarray, height: int, width: int, seed: int) -> Call:
    """Our image quilting with its defaults."""
    from torchtex.recipes.quilting import quilt

    return _recipe(exemplar, height, width, lambda z, size: quilt(z, size, seed=seed))


def patchwise(exemplar: np.ndarray, height: int, width: int, seed: int) -> Call:
    """Our patch-based sampling with its defaults."""
    from torchtex.recipes.patchwise import patchwise

    return _recipe(exemplar, height, width, lambda z, size: patchwise(z, size, seed=seed))


def graphcut(exemplar: np.ndarray, height: int, width: int, seed: int) -> Call:
    """Our graphcut textures with their defaults."""
    from torchtex.recipes.graphcut import graphcut

    return _recipe(exemplar, height, width, lambda z, size: graphcut(z, size, seed=seed))


def wang(exemplar: np.ndarray, height: int, width: int, seed: int) -> Call:
    """A set of Wang tiles of 64 px, or of what fits, and one texture laid with it."""
    from torchtex.recipes.wang import wang_tiles

    def make(z: Any, size: tuple[int, int]) -> Any:
        side = min(64, min(z.shape[1:]) * 4 // 5 // 2 * 2)
        return wang_tiles(z, tile=side, seed=seed).tile(size, seed=seed)

    return _recipe(exemplar, height, width, make)


def _torchtex(exemplar: np.ndarray, height: int, width: int, seed: int, **options: Any) -> Call:
    from torchtex import synthesize

    return _recipe(
        exemplar, height, width, lambda z, size: synthesize(z, size, seed=seed, **options)
    )


def _recipe(
    exemplar: np.ndarray, height: int, width: int, make: Callable[[Any, tuple[int, int]], Any]
) -> Call:
    import torch

    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    image = torch.from_numpy(exemplar).permute(2, 0, 1).float() / 255

    def call(image: torch.Tensor, size: tuple[int, int]) -> np.ndarray:
        texture = make(image, size).texture
        return (texture * 255).round().clamp(0, 255).byte().permute(1, 2, 0).numpy()

    call(image[:, :64, :64], (64, 64))  # warm up: lazy imports, thread pools
    return lambda: call(image, (height, width))


SYNTHESIZERS: dict[str, Callable[[np.ndarray, int, int, int], Call]] = {
    "gmic": gmic,
    "resynthesizer": resynthesizer,
    "torchtex": torchtex,
    "paper": paper,
    "quilt": quilt,
    "patchwise": patchwise,
    "graphcut": graphcut,
    "wang": wang,
}
MODULE = {
    "quilt": "recipes.quilting",
    "patchwise": "recipes.patchwise",
    "graphcut": "recipes.graphcut",
    "wang": "recipes.wang",
}


def worker(method: str, exemplar: str, out: str, seed: str) -> None:
    """Make one picture and print what it took, as JSON."""
    call = SYNTHESIZERS[method](np.array(Image.open(exemplar)), SIZE, SIZE, int(seed))
    before = _reset_peak_memory()
    start, start_cpu = time.perf_counter(), time.process_time()
    texture = call()
    seconds, cpu = time.perf_counter() - start, time.process_time() - start_cpu
    memory = (_memory("VmHWM") - before) / 1024
    if texture.shape != (SIZE, SIZE, 3) or texture.dtype != np.uint8:
        raise ValueError(f"{method} returned {texture.dtype} {texture.shape}")
    part = f"{out}.part"
    Image.fromarray(texture).save(part, format="PNG")
    os.replace(part, out)
    taken = {"seconds": seconds, "cpu_seconds": cpu, "memory_mib": memory}
    print(json.dumps({name: round(value, 3) for name, value in taken.items()}))


def _reset_peak_memory() -> int:
    """Start a new high-water mark where the system can, and return the present use in KiB."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _memory("VmRSS")


def _memory(key: str) -> int:
    """A memory figure of this process in KiB."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak // 1024 if sys.platform == "darwin" else peak
    return int(next(line for line in lines if line.startswith(key)).split()[1])


# From here on: the main process.


def peers_python(folder: Path) -> Path:
    """The interpreter of the peers' environment, which is made where it does not exist."""
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not python.exists():
        print(f"making {folder} with {', '.join(PACKAGES)}", flush=True)
        pip = [str(python), "-m", "pip", "install", "--quiet", *PACKAGES]
        for command in ([sys.executable, "-m", "venv", str(folder)], pip):
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                why = (done.stderr.strip().splitlines() or ["no message"])[-1]
                raise SystemExit(
                    f"--peers-env {folder}: the peers could not be installed ({why}); "
                    "remove it and try again, or name an environment that has them"
                )
    return python


def versions(python: str, packages: Iterable[str]) -> dict[str, str]:
    """Versions of packages in another environment."""
    code = (
        "import json, sys; from importlib.metadata import version; "
        "print(json.dumps({p: version(p) for p in sys.argv[1:]}))"
    )
    done = subprocess.run([python, "-c", code, *packages], capture_output=True, text=True)
    if done.returncode:
        why = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise SystemExit(
            f"--peers-env {Path(python).parents[1]} lacks a peer ({why}); "
            f"install {' '.join(PACKAGES)} there, or remove it to have it made anew"
        )
    return json.loads(done.stdout)


def fingerprint(*paths: Path) -> str:
    """A short hash of files: what a stored result depends on."""
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def modules(name: str) -> set[Path]:
    """The files of one module of torchtex, dotted, and of all its modules that it imports."""
    found: set[Path] = set()
    wanted = [name]
    while wanted:
        path = ROOT / "torchtex" / f"{wanted.pop().replace('.', '/')}.py"
        if path in found or not path.exists():
            continue
        found.add(path)
        wanted += re.findall(r"^\s*from torchtex\.([\w.]+) import", path.read_text(), re.MULTILINE)
    return found


def _source_hash(method: str) -> str:
    """A hash of how a method is called."""
    helpers = [] if method in PEERS else [_recipe]
    helpers += [_torchtex] if method in OURS else []
    functions = [worker, SYNTHESIZERS[method], *helpers]
    text = "".join(inspect.getsource(function) for function in functions)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _device() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _commit() -> str:
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=12"]
    done = subprocess.run(command, capture_output=True, text=True)
    return done.stdout.strip() or "unknown"


@dataclass
class Run:
    """One picture of one method: its measurements, or why there are none."""

    case: str
    method: str
    seed: int  # the strip's number for `real`
    metrics: dict[str, float] = field(default_factory=dict)
    taken: Taken = field(default_factory=dict)
    error: str | None = None


class Bench:
    """Makes and measures pictures under a folder, and keeps both."""

    def __init__(self, out: Path, threads: int, peers_env: Path, methods: list[str]) -> None:
        self.pictures = out / "peers"
        self.pictures.mkdir(parents=True, exist_ok=True)
        (self.pictures / ".gitignore").write_text("*\n")
        self.threads = threads
        peers = any(m in PEERS for m in methods)
        self.python = str(peers_python(peers_env)) if peers else sys.executable
        self.versions = versions(self.python, PACKAGES) if peers else {}
        self.source = fingerprint(*modules("synthesize"))
        self.measures = fingerprint(*modules("metrics"))
        self.calls = {name: _source_hash(name) for name in SYNTHESIZERS}

    def exemplar(self, case: Any) -> Path:
        """The exemplar as a file, for the workers and the contact sheets."""
        path = self.pictures / "exemplar" / f"{case.name}.png"
        path.parent.mkdir(exist_ok=True)
        pixels = (case.exemplar * 255).round().byte().permute(1, 2, 0).numpy()
        if not path.exists() or not np.array_equal(np.array(Image.open(path)), pixels):
            Image.fromarray(pixels).save(path)
        return path

    def picture(self, case: Any, method: str, seed: int) -> tuple[Path, Taken | None, str | None]:
        """One synthesis, from the store or made now: its file, what it took, or the error."""
        exemplar = self.exemplar(case)
        path = self.pictures / method / f"{case.name}_{seed}.png"
        path.parent.mkdir(exist_ok=True)
        made_by = {
            "version": self.versions.get(method)
            or fingerprint(*modules(MODULE.get(method, "synthesize"))),
            "call": self.calls[method],
            "exemplar": fingerprint(exemplar),
            "size": SIZE,
            "threads": self.threads,
        }
        store = _Store(path.with_suffix(".json"))
        taken, error = store.get("made", made_by), None
        if taken is None or not path.exists():
            taken, error = self._work(method, exemplar, path, seed)
            if taken is not None:
                store.put("made", made_by, taken)
        return path, taken, error

    def synthesis(self, case: Any, method: str, seed: int) -> Run:
        """One synthesis and its measurements."""
        import exemplars

        path, taken, error = self.picture(case, method, seed)
        if taken is None:
            return Run(case.name, method, seed, error=error)
        texture = exemplars.load(path)
        metrics = self._measured(path.with_suffix(".json"), case.exemplar, texture)
        return Run(case.name, method, seed, metrics, taken)

    def anchor(self, case: Any, method: str, index: int, texture: Any) -> Run:
        """A picture that nothing synthesised: a strip of the photo, or the exemplar repeated."""
        folder = self.pictures / method
        folder.mkdir(exist_ok=True)
        path = folder / f"{case.name}_{index}.json"
        return Run(case.name, method, index, self._measured(path, case.exemplar, texture))

    def _measured(self, path: Path, exemplar: Any, texture: Any) -> dict[str, float]:
        """The battery, from the store or computed now."""
        from torchtex.metrics import battery

        data = hashlib.sha256(exemplar.numpy().tobytes() + texture.numpy().tobytes())
        measured_by = {"measures": self.measures, "pictures": data.hexdigest()}
        store = _Store(path)
        metrics = store.get("metrics", measured_by)
        if metrics is None:
            measured = battery(texture, exemplar)
            metrics = {name: round(float(measured[name]), 5) for name in METRICS}
            store.put("metrics", measured_by, metrics)
        return metrics

    def _work(
        self, method: str, exemplar: Path, picture: Path, seed: int
    ) -> tuple[Taken | None, str | None]:
        python = self.python if method in PEERS else sys.executable
        threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(self.threads))
        path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        command = [python, __file__, "worker", method, str(exemplar), str(picture), str(seed)]
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            env={**os.environ, **threads, "PYTHONPATH": path},
        )
        if done.returncode:
            return None, (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1]
        return json.loads(done.stdout.splitlines()[-1]), None

    def runs(self, case: Any, method: str, seeds: int) -> Iterator[Run]:
        """All pictures of one method for one exemplar."""
        if method == "real":
            for index, strip in enumerate(case.rest):
                yield self.anchor(case, method, index, strip)
        elif method == "tile":
            yield self.anchor(case, method, 0, case.exemplar.repeat(1, 2, 2))
        else:
            for seed in range(seeds):
                yield self.synthesis(case, method, seed)

    def diversity(self, case: Any, method: str, seeds: int) -> float | None:
        """How far the pictures of different seeds lie apart; above 0.5 is free synthesis."""
        import exemplars

        from torchtex.metrics import diversity

        paths = [self.pictures / method / f"{case.name}_{seed}.png" for seed in range(seeds)]
        textures = [exemplars.load(path) for path in paths if path.exists()]
        return diversity(textures, case.exemplar) if len(textures) > 1 else None


class _Store:
    """Results in a JSON file, each with what it depends on; a result out of date is none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.data: dict[str, Any] = json.loads(path.read_text())
        except (OSError, ValueError):
            self.data = {}

    def get(self, name: str, key: dict[str, Any]) -> Any:
        entry = self.data.get(name)
        return entry["value"] if entry is not None and entry["key"] == key else None

    def put(self, name: str, key: dict[str, Any], value: Any) -> None:
        self.data[name] = {"key": key, "value": value}
        part = self.path.with_suffix(".json.part")
        part.write_text(json.dumps(self.data, indent=1))
        part.replace(self.path)


# Tables and verdict


Values = dict[str, float]


def summarise(runs: Iterable[Run]) -> dict[str, dict[str, Values]]:
    """case -> method -> the median over seeds; `real_worst` is the largest over the strips."""
    groups: dict[str, dict[str, list[Run]]] = {}
    for run in runs:
        if run.error is None:
            groups.setdefault(run.case, {}).setdefault(run.method, []).append(run)
    table: dict[str, dict[str, Values]] = {}
    for case, methods in groups.items():
        row = table.setdefault(case, {})
        for method, group in methods.items():
            row[method] = {m: median(r.metrics[m] for r in group) for m in METRICS}
            if all(r.taken for r in group):
                row[method] |= {name: median(r.taken[name] for r in group) for name in TAKEN}
            if method == "real":
                row["real_worst"] = {m: max(r.metrics[m] for r in group) for m in METRICS}
    return table


def medians(table: dict[str, dict[str, Values]]) -> dict[str, Values]:
    """method -> the median over those exemplars that have the method."""
    columns: dict[str, dict[str, list[float]]] = {}
    for row in table.values():
        for method, values in row.items():
            for name, value in values.items():
                columns.setdefault(method, {}).setdefault(name, []).append(value)
    return {m: {n: median(v) for n, v in names.items()} for m, names in columns.items()}


@dataclass(frozen=True)
class Target:
    """One promise, whether it is kept (None: not measured), and the exemplars that break it."""

    promise: str
    kept: bool | None
    figures: str
    losses: list[str]


def _against(
    table: dict[str, dict[str, Values]], name: str, rivals: tuple[str, ...], factor: float = 1.0
) -> tuple[float | None, float | None, list[str]]:
    """Our median, `factor` times the better rival's, and the exemplars on which we are worse.

    Only exemplars that we and all rivals have are counted, so that the medians compare.
    """
    rows = {c: r for c, r in table.items() if "torchtex" in r and all(m in r for m in rivals)}
    if not rows:
        return None, None, []
    ours = median(r["torchtex"][name] for r in rows.values())
    bound = factor * min(median(r[m][name] for r in rows.values()) for m in rivals)
    losses = []
    for case, row in rows.items():
        limit = factor * min(row[m][name] for m in rivals)
        if row["torchtex"][name] > limit:
            losses.append(f"{case} ({row['torchtex'][name]:.3f} against {limit:.3f})")
    return ours, bound, losses


def verdict(table: dict[str, dict[str, Values]]) -> list[Target]:
    """All targets, the lost ones too."""
    targets = []

    def compare(promise: str, name: str, rivals: tuple[str, ...], factor: float = 1.0) -> None:
        ours, bound, losses = _against(table, name, rivals, factor)
        if ours is None or bound is None:
            targets.append(Target(promise, None, "not measured", []))
        else:
            figures = f"{ours:.4f} against {bound:.4f}"
            targets.append(Target(promise, ours <= bound, figures, losses))

    for name in ("tail", "miss", "swd"):
        compare(f"median {name} no worse than the better peer's", name, PEERS)

    ours = {case: row["torchtex"] for case, row in table.items() if "torchtex" in row}
    for name, limit in (("copy", 0.10), ("repeat", 0.05)):
        promise = f"median {name} at most {limit:.2f}"
        if not ours:
            targets.append(Target(promise, None, "not measured", []))
            continue
        value = median(v[name] for v in ours.values())
        losses = [f"{c} ({v[name]:.3f})" for c, v in ours.items() if v[name] > limit]
        targets.append(Target(promise, value <= limit, f"{value:.4f}", losses))

    some, _, losses = _against(table, "miss", PEERS, 1.5)
    kept = None if some is None else not losses
    figures = "not measured" if some is None else f"{len(losses)} exemplars above"
    targets.append(
        Target("miss at most 1.5 times the better peer's on every exemplar", kept, figures, losses)
    )
    for name in ("swd", "tail", "spec"):
        promise = f"median {name} no worse than the real photo's (worst strip)"
        compare(promise, name, ("real_worst",))
    compare("median miss at most half of the paper's method", "miss", ("paper",), 0.5)
    compare("median tail at most 10 % above the paper's method", "tail", ("paper",), 1.1)
    return targets


ORDER = (*PEERS, *OURS, *RECIPES, "tile", "real", "real_worst")


def _row(method: str, values: Values) -> str:
    digits = dict.fromkeys(METRICS, 3) | {"seconds": 2, "cpu_seconds": 2, "memory_mib": 0}
    cells = (f"{values[n]:.{d}f}" if n in values else "" for n, d in digits.items())
    return f"| {NAMES[method]} | {' | '.join(cells)} |"


HEADER = [
    f"| method | {' | '.join(METRICS)} | s | CPU s | MiB |",
    f"|---{'|--:' * (len(METRICS) + len(TAKEN))}|",
]


def report(
    about: dict[str, Any],
    table: dict[str, dict[str, Values]],
    diversity: dict[str, float],
    targets: list[Target],
    errors: list[Run],
) -> str:
    """The results as Markdown."""
    packages = ", ".join(f"{k} {v}" for k, v in about["versions"].items())
    lines = [
        f"# {about['title']}",
        "",
        f"{len(table)} exemplars of at most {about['limit']} px a side to {SIZE} x {SIZE}, "
        f"{about['seeds']} seeds, {about['threads']} thread(s), {about['device']}. "
        f"Commit {about['commit']}; {packages}.",
        "",
        "Lower is better, but nothing is gained below *real*: other, disjoint parts of the same"
        " photo. *tile* is the exemplar repeated 2 x 2. s, CPU s and MiB: what the synthesis call"
        " took, and the memory that it added.",
        "",
        "## Medians over the exemplars",
        "",
        *HEADER,
    ]
    overall = medians(table)
    lines += [_row(m, overall[m]) for m in ORDER if m in overall]
    if diversity:
        shown = (f"{NAMES[m]} {v:.2f}" for m, v in diversity.items())
        lines += ["", f"Diversity between seeds (above 0.5 is free synthesis): {', '.join(shown)}."]
    if any(target.kept is not None for target in targets):
        lines += ["", "## Targets", "", "| target | | torchtex |", "|---|---|---|"]
        words = {True: "kept", False: "**lost**", None: "not measured"}
        lines += [f"| {t.promise} | {words[t.kept]} | {t.figures} |" for t in targets]
        if any(t.losses for t in targets):
            lines += ["", "Exemplars that do not meet a target by themselves:", ""]
        lines += [f"- {t.promise}: {', '.join(t.losses)}" for t in targets if t.losses]
    if errors:
        lines += ["", "## Failures", ""]
        lines += [f"- {NAMES[r.method]}, {r.case}, seed {r.seed}: {r.error}" for r in errors]
    lines += ["", "## Exemplars"]
    for case, row in table.items():
        lines += ["", f"### {case}", "", *HEADER]
        lines += [_row(m, row[m]) for m in ORDER if m in row]
    return "\n".join(lines) + "\n"


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    import exemplars

    parser = argparse.ArgumentParser(description="Compare torchtex with its peers.")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results", metavar="DIR")
    exemplars.add_argument(parser)
    parser.add_argument("--seeds", type=int, default=3, help="pictures per exemplar and method")
    parser.add_argument(
        "--peers-env",
        type=Path,
        default=ROOT / ".venv-peers",
        metavar="DIR",
        help="virtual environment of the peers, made where it does not exist",
    )
    default = [*PEERS, *OURS, *ANCHORS]
    every = [*default, *RECIPES]
    parser.add_argument("--methods", nargs="+", choices=every, default=default, metavar="METHOD")
    parser.add_argument("--report", default="peers", metavar="NAME", help="of the .json and .md")
    parser.add_argument("--limit", type=int, default=128, help="largest exemplar side in pixels")
    parser.add_argument("--limit-cases", type=int, metavar="N", help="only the first N exemplars")
    parser.add_argument("--threads", type=int, default=1, help="threads of each method")
    options = parser.parse_args(arguments)
    for name in ("seeds", "threads", "limit_cases"):
        value = getattr(options, name)
        if value is not None and value < 1:
            parser.error(f"--{name.replace('_', '-')}={value} must be at least 1")
    if options.limit < exemplars.NARROWEST:
        parser.error(f"--limit={options.limit} must be at least {exemplars.NARROWEST}")
    return options


def main() -> None:
    options = parse()
    import exemplars
    import torch

    torch.set_num_threads(options.threads)
    cases = exemplars.cases(options.exemplars, options.limit)[: options.limit_cases]
    bench = Bench(options.out, options.threads, options.peers_env, options.methods)
    runs: list[Run] = []
    spread: dict[str, list[float]] = {}
    for number, case in enumerate(cases, 1):
        for method in options.methods:
            runs += bench.runs(case, method, options.seeds)
            if method in SYNTHESIZERS:
                value = bench.diversity(case, method, options.seeds)
                spread.setdefault(method, []).extend([] if value is None else [value])
        print(f"{number}/{len(cases)} {case.name}", flush=True)
    if bench.source != fingerprint(*modules("synthesize")):
        print("torchtex was edited during the run: run again to replace older pictures", flush=True)
    about = {
        "title": options.report.capitalize(),
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            **bench.versions,
        },
        "device": _device(),
        "threads": options.threads,
        "commit": _commit(),
        "source": bench.source,
        "seeds": options.seeds,
        "limit": options.limit,
        "size": SIZE,
    }
    table = summarise(runs)
    diversity = {m: round(median(v), 4) for m, v in spread.items() if v}
    targets = verdict(table)
    errors = [run for run in runs if run.error is not None]
    everything = {
        **about,
        "medians": medians(table),
        "diversity": diversity,
        "targets": [asdict(target) for target in targets],
        "runs": [asdict(run) for run in runs],
    }
    (options.out / f"{options.report}.json").write_text(json.dumps(everything, indent=1) + "\n")
    text = report(about, table, diversity, targets, errors)
    (options.out / f"{options.report}.md").write_text(text)
    print(text.split("## Exemplars")[0])


if __name__ == "__main__":
    if sys.argv[1:2] == ["worker"]:
        worker(*sys.argv[2:])
    else:
        main()
