"""Sheets of a sweep of K and N, and other pictures of an analogy."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchtex.cli.analogy_jobs import Finished, How
from torchtex.extras import needed

if TYPE_CHECKING:
    import torch

    from torchtex.cli.base import Watch
    from torchtex.recipes.analogy import Analogy

_MOST = 48  # pictures of a sweep
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_SWEEP = re.compile(rf"([KN])=({_NUMBER}(?:,{_NUMBER})*)", re.IGNORECASE)


@dataclass(frozen=True)
class _Sheet:
    """The picture of a sweep."""

    texture: "torch.Tensor"
    runs: list[dict[str, Any]]

    def report(self) -> dict[str, Any]:
        """Of every run."""
        return {"runs": self.runs}


def grid_of(
    sweep: str | None,
    more: Sequence[str],
    how: How,
    labels: Path | None,
    patch_map: Path | None,
    curve: Path | None,
) -> dict[tuple[float | None, int | None], How] | None:
    """What to run for every K and N of a sweep; None without one."""
    if sweep is None:
        if more:
            raise ValueError(f"argument {more[0]!r} belongs to --sweep, which is not given")
        return None
    for name, path in (("labels", labels), ("patch_map", patch_map), ("curve", curve)):
        if path is not None:
            raise ValueError(f"{name}={str(path)!r} is of one picture; leave it or sweep out")
    text = " ".join([sweep, *more])
    found = {name.upper(): values.split(",") for name, values in _SWEEP.findall(text)}
    if _SWEEP.sub("", text).strip(" ,") or not found:
        raise ValueError(f"sweep={text!r} must be such as K=0.5,2,8,N=3,7")
    if not all(value.isdigit() and int(value) for value in found.get("N", [])):
        raise ValueError(f"sweep={text!r}: N must be whole numbers of at least 1")
    for name, fixed in (("K", how.k), ("N", how.n)):
        if name in found and fixed is not None:
            raise ValueError(f"{name.lower()}={fixed} is swept; leave it or sweep out")
    ks: list[float | None] = [float(v) for v in found.get("K", [])] or [how.k]
    ns: list[int | None] = [int(v) for v in found.get("N", [])] or [how.n]
    if len(ks) * len(ns) > _MOST:
        raise ValueError(f"sweep={text!r} makes {len(ks) * len(ns)} pictures; ask for {_MOST}")
    return {(k, n): replace(how, k=k, n=n) for k, n in product(ks, ns)}


def swept(
    problem: "Analogy", grid: dict[tuple[float | None, int | None], How], watch: "Watch"
) -> _Sheet:
    """The sheet of all pictures of a sweep, made one after another."""
    done, runs = {}, []
    for number, (place, how) in enumerate(grid.items()):

        def report(stage: Any, number: int = number) -> None:
            note = f"picture {number + 1} of {len(grid)}"
            watch(replace(stage, done=(number + stage.done) / len(grid), note=note))

        finished = how.run(problem, report)
        done[place] = finished.texture
        runs.append({"K": place[0], "N": place[1]} | finished.report())
    return _Sheet(_drawn_sheet(done), runs)


def _drawn_sheet(
    pictures: "dict[tuple[float | None, int | None], torch.Tensor]",
) -> "torch.Tensor":
    """Pictures side by side on white, each row with its K and each column with its N."""
    import torch

    ks = list(dict.fromkeys(k for k, _ in pictures))
    ns = list(dict.fromkeys(n for _, n in pictures))
    c, h, w = next(iter(pictures.values())).shape
    gap, left, top = 6, 64, 22
    page = torch.ones(c, top + len(ks) * (h + gap), left + len(ns) * (w + gap))
    for i, k in enumerate(ks):
        row = top + i * (h + gap)
        _write(page, row, 4, "" if k is None else f"K {k:g}")
        for j, n in enumerate(ns):
            col = left + j * (w + gap)
            _write(page, 2, col, "" if n is None else f"N {n}")
            page[:, row : row + h, col : col + w] = pictures[k, n]
    return page


def _write(page: "torch.Tensor", row: int, col: int, text: str) -> None:
    """Draws a short text, black, on a white part of a page."""
    import numpy as np
    import torch
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.new("L", (60, 18), 255)
    ImageDraw.Draw(picture).text((0, 0), text, 0, ImageFont.load_default(size=14))
    drawn = torch.from_numpy(np.array(picture)).to(page) / 255
    room = page[:, row : row + 18, col : col + 60]
    room.copy_(drawn[: room.shape[1], : room.shape[2]])


def patch_picture(done: Finished) -> "torch.Tensor":
    """Every copy in a colour of its own."""
    from torchtex.recipes.image_analogies import copies
    from torchtex.recipes.montage import Montage, color_labels

    if isinstance(done.made, Montage):
        return done.made.patch_picture()
    return color_labels(copies(done.made.source_map))


def curve_picture(done: Finished) -> "torch.Tensor":
    """The energy after each step, drawn by matplotlib."""
    import numpy as np
    import torch
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(range(1, len(done.curve) + 1), done.curve)
    axes.set_yscale("log")
    axes.set_xlabel("step")
    axes.set_ylabel("energy")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1).float() / 255


def check_plot() -> None:
    """Refuses a curve where nothing can draw it."""
    needed("matplotlib.figure", "curve")
