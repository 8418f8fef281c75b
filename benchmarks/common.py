"""What the benchmarks share: photos, timing, the record of where they ran, reports in JSON.

Only the standard library is imported at the top, since workers without torch read this file too.
"""

import json
import os
import platform
import statistics
import subprocess
import time
from importlib.metadata import version
from pathlib import Path


def timed(work, repeats):
    """Median and spread of the seconds of a call, and of its CPU seconds, after one warm-up.

    On a machine that does other work too, the CPU seconds of one thread are the fair figure.
    """
    work()
    seconds, cpu = [], []
    for _ in range(repeats):
        _, spent = once(work)
        seconds.append(spent["seconds"])
        cpu.append(spent["cpu"])
    return {
        "median": statistics.median(seconds),
        "least": min(seconds),
        "most": max(seconds),
        "cpu": statistics.median(cpu),
    }


def once(work, *given, **options):
    """What a call returns, and its wall and CPU seconds."""
    start, cpu = time.perf_counter(), time.process_time()
    found = work(*given, **options)
    return found, {"seconds": time.perf_counter() - start, "cpu": time.process_time() - cpu}


def add_arguments(parser, *, threads, repeats=None, sections=None, out=None):
    """The options that most benchmarks have."""
    from exemplars import add_argument

    add_argument(parser)
    parser.add_argument("--out", default=out or Path(__file__).parent / "results", type=Path)
    if threads is not None:
        parser.add_argument("--threads", type=int, default=threads)
    if repeats is not None:
        parser.add_argument("--repeats", type=int, default=repeats)
    if sections is not None:
        parser.add_argument("--sections", default=sections)


def photo_files(options):
    """The photos that `--exemplars` names, in order."""
    from exemplars import default_folder

    return sorted(Path(options.exemplars or default_folder()).glob("*.png"))


def photos_of(options):
    """The same, loaded, by name."""
    from exemplars import load

    return {path.stem: load(path) for path in photo_files(options)}


def environment(threads, *packages):
    """Versions, those of more packages too, and where the benchmark ran."""
    import torch

    import torchtex

    return {
        "torchtex": torchtex.__version__,
        "torch": torch.__version__,
        **{package.removesuffix("-cpu"): version(package) for package in packages},
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "threads": threads,
        "device": "cpu",
        "commit": commit(),
    }


def commit():
    """The short hash of the commit that is checked out."""
    command = ["git", "rev-parse", "--short", "HEAD"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


def measured(file, about, sections, wanted, each=None):
    """Runs some sections, each written as soon as it is done; the file's others are kept.

    Args:
        file: the JSON.
        about: what is said besides: environment, targets.
        sections: functions without arguments, by name.
        wanted: names, with commas between them.
        each: called with the whole report after every section.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    report = json.loads(file.read_text()) if file.exists() else {}
    report |= about
    for section in wanted.split(","):
        report[section] = sections[section]()
        file.write_text(json.dumps(report, indent=1) + "\n")
        if each is not None:
            each(report)
    return report
