"""`torchtex analogy`: an output that is to the constraint as the source is to its mapped image."""

import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import app
from torchtex.cli.files import choose, exemplar_path
from torchtex.cli.options import (
    Bits,
    KeepPartial,
    Labels,
    Output,
    PatchPicture,
    Quiet,
    Report,
    Seed,
    Threads,
)
from torchtex.cli.recipe import Outputs, carry_out

if TYPE_CHECKING:
    import torch

    from torchtex.cli.base import Watch
    from torchtex.recipes.analogy import Analogy
    from torchtex.recipes.montage import Montage
    from torchtex.result import Result

METHODS = ("cms", "analogies", "quilt", "random", "em")
_LOWERING = ("cms", "random")  # methods that minimise the energy of K and N
_OF = {
    "k": _LOWERING, "n": _LOWERING, "turns": _LOWERING, "mirrors": _LOWERING,
    "kappa": ("analogies",), "moves": ("random",), "sweep": _LOWERING,
    "curve": ("cms", "random", "em"),
}  # fmt: skip
"""Options of some methods alone."""
_MOST = 48  # pictures of a sweep
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_SWEEP = re.compile(rf"([KN])=({_NUMBER}(?:,{_NUMBER})*)", re.IGNORECASE)


@app.command()
def analogy(
    context: typer.Context,
    source: Annotated[
        list[str],
        typer.Option(help="S, a picture or the name of a bundled exemplar; may be repeated."),
    ],
    constraint: Annotated[
        list[str],
        typer.Option(
            help="C, a picture as large as the output; may be repeated. With --detail, the small "
            "picture to enlarge."
        ),
    ],
    output: Output,
    more: Annotated[
        list[str] | None, typer.Argument(metavar="", hidden=True, help="More of --sweep.")
    ] = None,
    mapped: Annotated[
        list[str] | None,
        typer.Option(
            help="Q, a picture aligned with the source; one for every source and constraint, those "
            "of the first source first."
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            help="cms, expansion moves; analogies, pixel by pixel; quilt, blocks; random, "
            "expansion moves of random labels; em, texture energy with guides."
        ),
    ] = "cms",
    k: Annotated[
        float | None,
        typer.Option(
            "--k", "-K", help="Weight of the constraint against seams, 1; of cms, random."
        ),
    ] = None,
    n: Annotated[
        int | None,
        typer.Option("--n", "-N", help="Reach of the windows in pixels, 3; of cms, random."),
    ] = None,
    turns: Annotated[
        bool | None,
        typer.Option("--turns/--no-turns", help="Whether cms and random turn the source; yes."),
    ] = None,
    mirrors: Annotated[
        bool, typer.Option("--mirrors", help="Let cms and random mirror the source, too.")
    ] = False,
    kappa: Annotated[
        float | None,
        typer.Option(help="How much coherent copies are preferred, 2; of analogies."),
    ] = None,
    moves: Annotated[
        int | None, typer.Option(help="Moves tried once all is covered, 500; of random.")
    ] = None,
    weight: Annotated[
        list[float] | None, typer.Option(help="Of a constraint; one each, or none for 1.")
    ] = None,
    detail: Annotated[
        float | None,
        typer.Option(
            metavar="FACTOR", help="Enlarge the constraint by it, with the detail of the source."
        ),
    ] = None,
    back_project: Annotated[
        bool,
        typer.Option(
            "--back-project", help="Of --detail: correct the colours by the small picture."
        ),
    ] = False,
    transfer: Annotated[
        bool, typer.Option("--transfer", help="Q and C are the lightness of S and C.")
    ] = False,
    blur: Annotated[
        float | None, typer.Option(help="Pixels that --transfer blurs both by, 0.")
    ] = None,
    numbers: Annotated[
        bool,
        typer.Option("--numbers", help="Q and C are maps of regions: clean their colours first."),
    ] = False,
    match_luminance: Annotated[
        bool,
        typer.Option(
            "--match-luminance",
            help="Give S and Q the mean and deviation of C's lightness; with --transfer, C those "
            "of S.",
        ),
    ] = False,
    sweep: Annotated[
        str | None,
        typer.Option(
            metavar="K=..,..[,N=..]", help="Make a sheet of pictures, a row per K, a column per N."
        ),
    ] = None,
    seed: Seed = 0,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    patch_map: PatchPicture = None,
    curve: Annotated[
        Path | None, typer.Option(help="Picture of the falling energy to write.")
    ] = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> None:
    """Make a picture that is to the constraint as the source is to its mapped image."""
    choose("method", method, METHODS)
    given = {
        "k": k, "n": n, "turns": turns, "mirrors": mirrors or None, "kappa": kappa,
        "moves": moves, "sweep": sweep, "curve": curve,
    }  # fmt: skip
    _check_method(method, given)
    job = _Job(
        tuple(source), tuple(mapped or ()), tuple(constraint), tuple(weight or ()),
        detail, back_project, transfer, blur, numbers, match_luminance,
    )  # fmt: skip
    how = _How(method, k, n, turns is not False, mirrors, kappa, moves, seed)
    grid = _grid(sweep, more or [], how, labels, patch_map, curve)
    if curve is not None:
        _check_plot()

    def make(watch: "Watch") -> Any:
        problem = job.problem(quiet)
        for each in grid.values() if grid else [how]:
            _check_window(each, problem)
        if grid is not None:
            return _swept(problem, grid, watch)
        return job.judged(how.run(problem, watch), quiet)

    pictures: list[tuple[str, Path | None, Callable[[Any], torch.Tensor]]] = [
        ("patch_map", patch_map, _patch_picture),
        ("curve", curve, _curve_picture),
    ]
    outputs = Outputs(output, bits, labels, report, pictures)
    carry_out(
        context, outputs, job.read(), make, threads=threads, keep_partial=keep_partial, quiet=quiet
    )


@dataclass(frozen=True)
class _Finished:
    """A picture, with what else is to be told about it."""

    made: "Montage | Result"
    curve: tuple[float, ...] = ()
    about: dict[str, Any] = field(default_factory=dict)
    corrected: "torch.Tensor | None" = None

    @property
    def texture(self) -> "torch.Tensor":
        """The picture."""
        return self.made.texture if self.corrected is None else self.corrected

    @property
    def field(self) -> Any:
        """Where every pixel is from."""
        return self.made.field

    def report(self) -> dict[str, Any]:
        """Settings, timing and energies."""
        return self.made.report() | self.about


@dataclass(frozen=True)
class _Job:
    """The files, and how they make an analogy."""

    sources: tuple[str, ...]
    mapped: tuple[str, ...]
    constraints: tuple[str, ...]
    weights: tuple[float, ...]
    detail: float | None
    back_project: bool
    transfer: bool
    blur: float | None
    numbers: bool
    match: bool

    def __post_init__(self) -> None:
        kinds = {"detail": self.detail is not None, "transfer": self.transfer,
                 "numbers": self.numbers}  # fmt: skip
        chosen = [name for name, on in kinds.items() if on]
        if len(chosen) > 1:
            raise ValueError(f"{chosen[0]} does not go with {chosen[1]}; leave one of them out")
        if self.blur is not None and not self.transfer:
            raise ValueError(f"blur={self.blur} needs --transfer; leave it out")
        if self.back_project and self.detail is None:
            raise ValueError("back_project needs --detail; leave it out")
        if self.match and (self.numbers or self.detail is not None):
            raise ValueError(f"match_luminance does not go with {chosen[0]}; leave it out")
        if self.detail is not None and not 2 <= self.detail < float("inf"):
            raise ValueError(f"detail={self.detail} must be at least 2, the factor to enlarge by")
        if chosen and len(self.constraints) > 1:
            raise ValueError(
                f"constraint: {len(self.constraints)} given; {chosen[0]} takes one"
            )  # fmt: skip
        if chosen and chosen[0] != "detail" and len(self.sources) > 1:
            raise ValueError(f"source: {len(self.sources)} given; {chosen[0]} takes one")
        self._check_mapped()

    def _check_mapped(self) -> None:
        if self.detail is not None or self.transfer:
            if self.mapped:
                name = "transfer" if self.transfer else "detail"
                raise ValueError(
                    f"mapped={self.mapped[0]!r}: {name} makes it of the source; leave it out"
                )
            return
        wanted = len(self.sources) * len(self.constraints)
        if len(self.mapped) != wanted:
            raise ValueError(
                f"mapped: {len(self.mapped)} given for {len(self.sources)} sources and "
                f"{len(self.constraints)} constraints; repeat --mapped {wanted} times, those of "
                "the first source first"
            )

    def read(self) -> dict[str, Path]:
        """Files that decide the pixels, by the names they were given under."""
        found: dict[str, Path] = {}
        for kind, names in (
            ("source", self.sources), ("mapped", self.mapped), ("constraint", self.constraints)
        ):  # fmt: skip
            for name in names:
                path = found[name] = exemplar_path(name) if kind == "source" else Path(name)
                if not path.exists():
                    raise ValueError(f"{kind}={name!r}: there is no such file; check the name")
        return found

    def problem(self, quiet: bool) -> "Analogy":
        """Loads, and makes what is not given."""
        from torchtex.recipes.analogy import Analogy
        from torchtex.recipes.transfers import luminance_matched, transfer_problem

        sources = [_load(str(exemplar_path(name)), "source") for name in self.sources]
        constraints = tuple(_load(name, "constraint") for name in self.constraints)
        if self.detail is not None:
            return self._detail(sources, constraints[0])
        if self.transfer:
            made = transfer_problem(
                sources[0], constraints[0], blur=self.blur or 0.0, match=self.match
            )
            return replace(made, weights=self.weights)
        maps = [_load(name, "mapped") for name in self.mapped]
        if self.numbers:
            maps, constraints = _snapped(maps[0], constraints[0], quiet)
        count = len(constraints)
        mapped = tuple(tuple(maps[i : i + count]) for i in range(0, len(maps), count))
        problem = Analogy(tuple(sources), mapped, constraints, self.weights)
        return luminance_matched(problem) if self.match else problem

    def _detail(self, sources: "list[torch.Tensor]", low: "torch.Tensor") -> "Analogy":
        from torchtex.recipes.analogy import Analogy
        from torchtex.recipes.detail import detail_problem

        assert self.detail is not None
        each = [detail_problem(s, low, self.detail) for s in sources]
        return Analogy(
            tuple(p.sources[0] for p in each), tuple(p.mapped[0] for p in each),
            each[0].constraints, self.weights,
        )  # fmt: skip

    def judged(self, done: _Finished, quiet: bool) -> _Finished:
        """With --detail, how well the output agrees with the small picture."""
        from torchtex.recipes.detail import back_projected, detail_error

        if self.detail is None:
            return done
        low = _load(self.constraints[0], "constraint")
        if self.back_project:
            done = replace(done, corrected=back_projected(done.texture, low, self.detail))
        error = detail_error(done.texture, low, self.detail)
        if not quiet:
            print(f"reduced again, the output is {100 * error:.2f} % off", file=sys.stderr)
        return replace(done, about=done.about | {"detail_error": error})


@dataclass(frozen=True)
class _How:
    """A method and its options."""

    method: str
    k: float | None
    n: int | None
    turns: bool
    mirrors: bool
    kappa: float | None
    moves: int | None
    seed: int

    def run(self, problem: "Analogy", watch: "Callable[[Any], None]") -> _Finished:
        """The output of the method."""
        from torchtex.recipes import image_analogies, rivals

        if self.method in _LOWERING:
            return self._lowered(problem, watch)
        if self.method == "analogies":
            kappa = 2.0 if self.kappa is None else self.kappa
            return _Finished(
                image_analogies.image_analogies(
                    problem, kappa=kappa, seed=self.seed, on_step=watch
                )
            )  # fmt: skip
        if self.method == "quilt":
            return _Finished(rivals.constrained_quilting(problem, seed=self.seed, on_step=watch))
        made = rivals.guided(problem, seed=self.seed, on_step=watch)
        return _Finished(made, made.energies)

    def _lowered(self, problem: "Analogy", watch: "Callable[[Any], None]") -> _Finished:
        from torchtex.recipes import cms, rivals

        k, n = 1.0 if self.k is None else self.k, 3 if self.n is None else self.n
        made: cms.CmsResult
        if self.method == "cms":
            made = cms.cms(
                problem, K=k, N=n, turns=self.turns, mirrors=self.mirrors, seed=self.seed,
                on_step=watch,
            )  # fmt: skip
        else:
            made = rivals.random_placement(
                problem, K=k, N=n, moves=500 if self.moves is None else self.moves,
                turns=self.turns, mirrors=self.mirrors, seed=self.seed, on_step=watch,
            )  # fmt: skip
        about = {"energies": asdict(made.energies), "moves": len(made.moves), "tried": made.tried}
        return _Finished(made.montage, tuple(move.energy for move in made.moves), about)


@dataclass(frozen=True)
class _Sheet:
    """The picture of a sweep."""

    texture: "torch.Tensor"
    runs: list[dict[str, Any]]

    def report(self) -> dict[str, Any]:
        """Of every run."""
        return {"runs": self.runs}


def _check_method(method: str, given: dict[str, Any]) -> None:
    """Refuses options that the method has no use for."""
    for name, value in given.items():
        if value is not None and method not in _OF[name]:
            raise ValueError(
                f"{name}={value} is of the methods {', '.join(_OF[name])}, not of "
                f"method={method!r}; leave one of them out"
            )
    if given["k"] is not None and not 0 <= given["k"] < float("inf"):
        raise ValueError(f"k={given['k']} must be at least 0, and finite")
    if given["n"] is not None and given["n"] < 1:
        raise ValueError(f"n={given['n']} must be at least 1; a window has 2 N + 1 pixels a side")


def _check_window(how: _How, problem: "Analogy") -> None:
    n = 3 if how.n is None else how.n
    shortest = min(*problem.size, *(min(shape) for shape in problem.shapes))
    if how.method in _LOWERING and 2 * n + 1 > shortest:
        raise ValueError(
            f"n={n} makes windows of {2 * n + 1} pixels, and the shortest side of the images is "
            f"{shortest}; choose a smaller n"
        )


def _check_plot() -> None:
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise ImportError("curve needs matplotlib; install torchtex[plot]") from None


def _load(path: str, name: str) -> "torch.Tensor":
    from torchtex import image as images

    return images.load(path, alpha=False, name=name).image


def _snapped(
    mapped: "torch.Tensor", constraint: "torch.Tensor", quiet: bool
) -> "tuple[list[torch.Tensor], tuple[torch.Tensor, ...]]":
    from torchtex.recipes.region_maps import snapped

    clean = snapped(mapped, constraint)
    if any(clean.changed) and not quiet:
        print(
            f"numbers: {clean.changed[0]} pixels of mapped and {clean.changed[1]} of constraint "
            f"were snapped to {len(clean.palette)} colours",
            file=sys.stderr,
        )
    return [clean.mapped], (clean.constraint,)


def _grid(
    sweep: str | None,
    more: Sequence[str],
    how: _How,
    labels: Path | None,
    patch_map: Path | None,
    curve: Path | None,
) -> dict[tuple[float | None, int | None], _How] | None:
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


def _swept(
    problem: "Analogy", grid: dict[tuple[float | None, int | None], _How], watch: "Watch"
) -> _Sheet:
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


def _patch_picture(done: _Finished) -> "torch.Tensor":
    from torchtex.recipes.image_analogies import copies
    from torchtex.recipes.montage import Montage, color_labels

    if isinstance(done.made, Montage):
        return done.made.patch_picture()
    return color_labels(copies(done.made.source_map))


def _curve_picture(done: _Finished) -> "torch.Tensor":
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
