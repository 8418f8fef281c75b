"""`torchtex graphcut`: copies of the exemplar, joined along the best seams."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchtex.cli.base import Watch, app
from torchtex.cli.files import choose, exemplar_path, extent_of, parse_size, same_channels
from torchtex.cli.options import (
    Bits,
    Exemplars,
    KeepPartial,
    Labels,
    Output,
    PatchPicture,
    Quiet,
    Report,
    SeamPicture,
    Seed,
    Size,
    Threads,
)
from torchtex.cli.recipe import Outputs, carry_out

if TYPE_CHECKING:
    import torch

    from torchtex.cuts.mincut import MinCut
    from torchtex.recipes.graphcut import Placement
    from torchtex.recipes.montage import Montage

PLACEMENTS = ("random", "entire", "sub")
BOUNDARIES = ("free", "periodic")


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
    boundary: Annotated[
        str, typer.Option(help="free, or periodic for a texture that tiles.")
    ] = "free",
    solver: Annotated[
        str | None, typer.Option(help="Of the min-cuts: pymaxflow or ortools.")
    ] = None,
    mask: Annotated[
        list[str] | None, typer.Option(help="White where the exemplar may be used; one each.")
    ] = None,
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
    choose("boundary", boundary, BOUNDARIES)
    drawn = list(mask or ())
    if drawn and len(drawn) != len(exemplar):
        raise ValueError(
            f"mask: {len(drawn)} given for {len(exemplar)} exemplars; "
            "repeat --mask once per exemplar"
        )
    chosen = _solver(solver)
    read = {name: exemplar_path(name) for name in exemplar} | {name: Path(name) for name in drawn}

    def make(watch: Watch) -> "Montage":
        from torchtex.recipes import graphcut as recipe

        images, masks = _load(exemplar, drawn)
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
            boundary="periodic" if boundary == "periodic" else "free",
            masks=masks,
            solver=chosen,
            seed=seed,
            on_step=watch,
        )

    pictures = [
        ("seams", seams, lambda result: result.seam_picture()),
        ("patch_map", patch_map, lambda result: result.patch_picture()),
    ]
    carry_out(
        context,
        Outputs(output, bits, labels, report, pictures),
        read,
        make,
        threads=threads,
        keep_partial=keep_partial,
        quiet=quiet,
    )


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


def _solver(name: str | None) -> "MinCut":
    """The back end of that name, if it is there."""
    from torchtex.cuts.mincut import OrTools, PyMaxflow, default_solver, solvers

    if name is None:
        return default_solver()
    made: dict[str, Callable[[], MinCut]] = {"pymaxflow": PyMaxflow, "ortools": OrTools}
    if name not in made:
        there = ", ".join(known for known, usable in solvers().items() if usable) or "none"
        raise ValueError(f"solver={name!r} is unknown; those installed here: {there}")
    return made[name]()


def _load(
    names: list[str], drawn: list[str]
) -> "tuple[list[torch.Tensor], list[torch.Tensor | None]]":
    """Exemplars, and where each may be used: where it is opaque, and its mask is white."""
    from torchtex import image as images

    pictures = [images.load(exemplar_path(name), name="exemplar") for name in names]
    masks = [picture.mask for picture in pictures]
    for number, name in enumerate(drawn):
        white = images.load_mask(name, extent_of(pictures[number].image), name="mask")
        alpha = masks[number]
        both = masks[number] = white if alpha is None else white & alpha
        if not bool(both.any()):
            raise ValueError(
                f"mask={name!r} is white only where its exemplar is transparent; widen it"
            )
    return same_channels([picture.image for picture in pictures]), masks
