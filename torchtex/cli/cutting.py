"""`torchtex graphcut`: copies of the exemplar, joined along the best seams."""

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from torchtex.cli.base import Watch, app
from torchtex.cli.files import (
    boundary_of,
    choose,
    load_exemplars,
    parse_size,
    read_files,
    solver_of,
)
from torchtex.cli.options import (
    Bits,
    Boundary,
    Exemplars,
    KeepPartial,
    Labels,
    Masks,
    Output,
    PatchPicture,
    Quiet,
    Report,
    SeamPicture,
    Seed,
    Size,
    Solver,
    Threads,
)
from torchtex.cli.recipe import Outputs, carry_out, patch_pictures

if TYPE_CHECKING:
    from torchtex.recipes.graphcut import Placement
    from torchtex.recipes.montage import Montage

PLACEMENTS = ("random", "entire", "sub")


@app.command()
def graphcut(
    context: typer.Context,
    exemplar: Exemplars,
    output: Output,
    size: Size,
    placement: Annotated[
        str,
        typer.Option(
            help="What decides where a patch goes: random, entire (all it covers), or sub (a "
            "square around the place)."
        ),
    ] = "sub",
    patch: Annotated[
        int | None, typer.Option(help="Side of that square in pixels; of placement sub alone.")
    ] = None,
    k: Annotated[
        float | None, typer.Option(help="How freely patches are drawn: 0.001 strict, 1 free.")
    ] = None,
    spread: Annotated[
        float | None,
        typer.Option(help="How strongly the parts of the exemplar take turns; 0: not."),
    ] = None,
    refine: Annotated[
        int | None, typer.Option(help="Patches laid over the worst seams; else by the size.")
    ] = None,
    turns: Annotated[bool, typer.Option("--turns", help="Also patches turned by 90 degrees.")] = (
        False
    ),
    mirrors: Annotated[bool, typer.Option("--mirrors", help="Also mirrored patches.")] = False,
    scales: Annotated[str, typer.Option(help="Scales of the patches, such as 0.8,1,1.25.")] = "1",
    gradient: Annotated[
        bool, typer.Option("--gradient/--no-gradient", help="Seams follow edges.")
    ] = True,
    poisson: Annotated[
        bool, typer.Option("--poisson", help="Even out brightness across seams.")
    ] = False,
    boundary: Boundary = "free",
    solver: Solver = None,
    mask: Masks = None,
    seed: Seed = 0,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    seams: SeamPicture = None,
    patch_map: PatchPicture = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> None:
    """Make a texture of overlapping copies of the exemplars, joined along seams of least cost."""
    extent = parse_size(size)
    where = _placement(placement, patch, k, spread)
    factors = parse_scales(scales)
    border = boundary_of(boundary)
    chosen = solver_of(solver)
    drawn = mask or []
    read = read_files(exemplar, drawn)

    def make(watch: Watch) -> "Montage":
        from torchtex.recipes import graphcut as recipe

        images, masks = load_exemplars(exemplar, drawn)
        return recipe.graphcut(
            images,
            extent,
            placement=where,
            gradient=gradient,
            refine=refine,
            turns=turns,
            mirrors=mirrors,
            scales=factors,
            poisson=poisson,
            boundary=border,
            masks=masks,
            solver=chosen,
            seed=seed,
            on_step=watch,
        )

    outputs = Outputs(output, bits, labels, report, patch_pictures(seams, patch_map))
    carry_out(context, outputs, read, make, threads=threads, keep_partial=keep_partial, quiet=quiet)


def parse_scales(text: str) -> tuple[float, ...]:
    """Scales with commas between them as numbers.

    Example:
        >>> parse_scales("0.8,1")
        (0.8, 1.0)
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(re.fullmatch(r"\d{1,9}(\.\d*)?|\.\d+", part) for part in parts):
        raise ValueError(f"scales={text!r} must be numbers above 0, such as 0.8,1,1.25")
    return tuple(float(part) for part in parts)


def _placement(name: str, patch: int | None, k: float | None, spread: float | None) -> "Placement":
    choose("placement", name, PLACEMENTS)
    if patch is not None and name != "sub":
        raise ValueError(f"patch={patch} belongs to placement sub; leave it out, or choose sub")
    for option, value in (("k", k), ("spread", spread)):
        if value is not None and name == "random":
            raise ValueError(f"{option}={value} belongs to placements entire and sub; leave it out")
    from torchtex.recipes.graphcut import EntirePatch, Random, SubPatch

    if name == "random":
        return Random()
    made = EntirePatch() if name == "entire" else SubPatch(patch)
    made = made if k is None else replace(made, k=k)
    return made if spread is None else replace(made, spread=spread)
