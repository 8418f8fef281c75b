"""`torchtex metrics` and `torchtex info`."""

import json
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import typer

from torchtex.cli.base import app
from torchtex.cli.files import exemplar_path, same_channels
from torchtex.extras import EXTRAS, installed


@app.command()
def metrics(
    texture: Annotated[Path, typer.Argument(help="The texture to be measured.")],
    exemplar: Annotated[str, typer.Option(help="What it should look like: picture or name.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    tileable: Annotated[
        bool, typer.Option("--tileable", help="Measure the seam of the tiled texture too.")
    ] = False,
) -> None:
    """Measure how well a texture matches its exemplar. Transparency is dropped."""
    from torchtex import image as images
    from torchtex.metrics import battery

    theirs = images.load(exemplar_path(exemplar), alpha=False, name="exemplar").image
    ours = images.load(texture, alpha=False, name="texture").image
    ours, theirs = same_channels([ours, theirs])
    values = battery(ours, theirs, tileable=tileable)
    if as_json:
        print(json.dumps(values, indent=2))
    else:
        for name, value in values.items():
            print(f"{name:10} {value:.4f}")


@app.command()
def info(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print versions, devices, threads, extras and the bundled exemplars."""
    values = _info()
    if as_json:
        print(json.dumps(values, indent=2))
        return
    for name, value in values.items():
        shown = ", ".join(value) if isinstance(value, list) else value
        if isinstance(value, dict):
            shown = ", ".join(f"{key} {item}" for key, item in value.items())
        print(f"{name:12} {shown}")


def _info() -> dict[str, Any]:
    import platform

    import torch

    import torchtex
    from torchtex import data
    from torchtex.cuts.mincut import solvers
    from torchtex.matching import faiss_library

    versions = {"torchtex": torchtex.__version__, "python": platform.python_version()}
    for name in ("torch", "numpy", "kornia", "PyWavelets", "faiss-cpu", "Pillow"):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "missing"
    devices = ["cpu"]
    devices += [f"cuda:{number}" for number in range(torch.cuda.device_count())]
    if torch.backends.mps.is_available():
        devices.append("mps")
    if hasattr(torch, "xpu") and torch.xpu.is_available():
        devices.append("xpu")
    faiss = faiss_library()
    options = getattr(faiss, "get_compile_options", str)
    return {
        "versions": versions,
        "devices": devices,
        "threads": torch.get_num_threads(),
        "faiss": options().strip(),
        "extras": {extra: "installed" if installed(extra) else "missing" for extra in EXTRAS},
        "min-cut": {name: "installed" if there else "missing" for name, there in solvers().items()},
        "exemplars": list(data.names()),
    }
