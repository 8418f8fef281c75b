"""`torchtex analogy`: an output that is to the constraint as the source is to its mapped image."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.analogy_jobs import LOWERING, How, Job
from torchtex.cli.analogy_sheets import check_plot, curve_picture, grid_of, patch_picture, swept
from torchtex.cli.base import app
from torchtex.cli.files import choose
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
    from collections.abc import Callable

    import torch

    from torchtex.cli.base import Watch
    from torchtex.recipes.analogy import Analogy

METHODS = ("cms", "analogies", "quilt", "random", "em")
_OF = {
    "k": LOWERING, "n": LOWERING, "turns": LOWERING, "mirrors": LOWERING, "mask": LOWERING,
    "kappa": ("analogies",), "moves": ("random",), "tolerance": ("cms",), "paper": ("cms",),
    "sweep": LOWERING, "curve": ("cms", "random", "em"),
}  # fmt: skip
"""Options of some methods alone."""


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
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="E' must fall by more in 5 moves, K + 2, or 5 (K + 2) for --detail; of cms."
        ),
    ] = None,
    paper: Annotated[
        bool, typer.Option("--paper", help="Search the worst places one by one; of cms.")
    ] = False,
    mask: Annotated[
        list[str] | None,
        typer.Option(help="White where the source may be used; one each; of cms, random."),
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
        bool | None,
        typer.Option(
            "--back-project/--no-back-project",
            help="Of --detail: correct the colours by the small picture; yes.",
        ),
    ] = None,
    transfer: Annotated[
        bool, typer.Option("--transfer", help="Q and C are the lightness of S and C.")
    ] = False,
    blur: Annotated[
        float | None, typer.Option(help="Pixels that --transfer blurs both by, 0.")
    ] = None,
    contrast: Annotated[
        float | None,
        typer.Option(help="Times the deviation of the constraint's lightness with --transfer, 1."),
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
        "moves": moves, "sweep": sweep, "curve": curve, "tolerance": tolerance,
        "paper": paper or None, "mask": mask[0] if mask else None,
    }  # fmt: skip
    _check_method(method, given)
    job = Job(
        tuple(source), tuple(mapped or ()), tuple(constraint), tuple(weight or ()),
        detail, back_project, transfer, blur, contrast, numbers, match_luminance,
        tuple(mask or ()),
    )  # fmt: skip
    how = How(
        method,
        k,
        n,
        turns is not False,
        mirrors,
        kappa,
        moves,
        tolerance,
        paper,
        detail is not None,
        seed,
    )
    grid = grid_of(sweep, more or [], how, labels, patch_map, curve)
    if curve is not None:
        check_plot()

    def make(watch: "Watch") -> Any:
        problem = job.problem(quiet)
        for each in grid.values() if grid else [how]:
            _check_window(each, problem)
        if grid is not None:
            return swept(problem, grid, watch)
        return job.judged(how.run(problem, watch), quiet)

    pictures: list[tuple[str, Path | None, Callable[[Any], torch.Tensor]]] = [
        ("patch_map", patch_map, patch_picture),
        ("curve", curve, curve_picture),
    ]
    outputs = Outputs(output, bits, labels, report, pictures)
    carry_out(
        context, outputs, job.read(), make, threads=threads, keep_partial=keep_partial, quiet=quiet
    )


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


def _check_window(how: How, problem: "Analogy") -> None:
    n = 3 if how.n is None else how.n
    shortest = min(*problem.size, *(min(shape) for shape in problem.shapes))
    if how.method in LOWERING and 2 * n + 1 > shortest:
        raise ValueError(
            f"n={n} makes windows of {2 * n + 1} pixels, and the shortest side of the images is "
            f"{shortest}; choose a smaller n"
        )
