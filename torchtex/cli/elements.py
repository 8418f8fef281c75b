"""`torchtex density`: more or fewer elements in a picture, here or there."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchtex.cli.base import app
from torchtex.cli.files import exemplar_path, extent_of, parse_size, solver_of
from torchtex.cli.options import (
    Bits,
    ExemplarName,
    KeepPartial,
    Labels,
    Output,
    PatchPicture,
    Plain,
    Quiet,
    Report,
    SeamPicture,
    Seed,
    Solver,
    Threads,
)
from torchtex.cli.recipe import Outputs, carry_out, patch_pictures

if TYPE_CHECKING:
    import torch

    from torchtex.cli.base import Watch
    from torchtex.recipes.montage import Montage


@app.command()
def density(
    context: typer.Context,
    image: ExemplarName,
    output: Output,
    amount: Annotated[
        float | None,
        typer.Option(help="Times as many elements: 0 none, 0.5 every other one, 2 twice as many."),
    ] = None,
    map: Annotated[
        str | None,
        typer.Option(help="Picture, of the result's size: --low where black, --high where white."),
    ] = None,
    low: Annotated[float, typer.Option(help="Amount where the map is black.")] = 0.0,
    high: Annotated[float, typer.Option(help="Amount where the map is white.")] = 2.0,
    size: Annotated[
        str | None,
        typer.Option(help="HEIGHTxWIDTH of a new picture; IMAGE itself is changed unless given."),
    ] = None,
    mask: Annotated[
        str | None, typer.Option(help="White on the elements; found by colour unless given.")
    ] = None,
    at: Annotated[
        str | None, typer.Option(help="ROW,COL in an element, if the wrong ones are found.")
    ] = None,
    colors: Annotated[int, typer.Option(help="Clusters of colours, 2..6.")] = 3,
    least: Annotated[int | None, typer.Option(help="Smallest element in pixels.")] = None,
    ground: Annotated[
        str | None, typer.Option(help="Picture of what is below; IMAGE's own ground unless given.")
    ] = None,
    gap: Annotated[int, typer.Option(help="Pixels between new elements and others.")] = 2,
    turn: Annotated[bool, typer.Option(help="Turn and mirror new elements.")] = True,
    plain: Plain = False,
    solver: Solver = None,
    seed: Seed = 0,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    preview: Annotated[
        Path | None,
        typer.Option(help="Picture of the elements found to write, also if they are refused."),
    ] = None,
    seams: SeamPicture = None,
    patch_map: PatchPicture = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> None:
    """Change how many elements a picture has: flowers on a meadow, olives on a plate."""
    if (amount is None) == (map is None):
        raise ValueError("amount and map: give one of them, --amount 2 or --map PICTURE")
    wanted = None if size is None else parse_size(size)
    point = None if at is None else _point(at)
    chosen = solver_of(solver)
    read = {image: exemplar_path(image)}
    read |= {name: Path(name) for name in (map, mask) if name is not None}
    if ground is not None:
        read[ground] = exemplar_path(ground)
    found: list[torch.Tensor] = []

    def make(watch: "Watch") -> "Montage":
        from torchtex import image as images
        from torchtex.layers.elements import find_elements
        from torchtex.recipes import density as recipe

        picture = images.load(exemplar_path(image), alpha=False, name="image").image
        marked = None
        if mask is not None:
            marked = images.load_mask(mask, extent_of(picture), name="mask")
        elements = find_elements(
            picture,
            marked,
            at=point,
            colors=colors,
            least=least,
            seed=seed,
        )
        found.append(elements.picture(picture))
        if preview is not None:  # now: it shows why they may be refused
            images.save(preview, found[0], name="preview")
        below = None
        if ground is not None:
            below = images.load(exemplar_path(ground), alpha=False, name="ground").image
        return recipe.density(
            picture,
            _amount(amount, map, low, high, extent_of(picture) if wanted is None else wanted),
            elements=elements,
            ground=below,
            size=wanted,
            gap=gap,
            turn=turn,
            poisson=not plain,
            solver=chosen,
            seed=seed,
            on_step=watch,
        )

    pictures = [*patch_pictures(seams, patch_map), ("preview", preview, lambda _: found[0])]
    carry_out(
        context,
        Outputs(output, bits, labels, report, pictures),
        read,
        make,
        threads=threads,
        keep_partial=keep_partial,
        quiet=quiet,
    )


def _amount(
    amount: float | None, name: str | None, low: float, high: float, size: tuple[int, int]
) -> "float | torch.Tensor":
    from torchtex import image as images

    if name is None:
        return 1.0 if amount is None else amount
    grey = images.luminance(images.load(name, alpha=False, name="map").image)
    if tuple(grey.shape) != size:
        raise ValueError(
            f"map={name!r} has {grey.shape[0]}x{grey.shape[1]} pixels and the result "
            f"{size[0]}x{size[1]}; make them the same size"
        )
    return low + (high - low) * grey


def _point(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,9}),(\d{1,9})", text)
    if found is None:
        raise ValueError(f"at={text!r} is not ROW,COL; write it like 12,40")
    return int(found[1]), int(found[2])
