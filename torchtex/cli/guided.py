"""`torchtex fill` and `torchtex mix`: holes filled from a photo, exemplars mixed by maps."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import app
from torchtex.cli.files import (
    boundary_of,
    exemplar_path,
    extent_of,
    load_exemplars,
    parse_size,
    read_files,
    solver_of,
)
from torchtex.cli.options import (
    Bits,
    Boundary,
    ExemplarName,
    Exemplars,
    KeepPartial,
    Labels,
    Masks,
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
def fill(
    context: typer.Context,
    image: ExemplarName,
    mask: Annotated[str, typer.Option(help="Picture of the image's size, white in the holes.")],
    output: Output,
    confidence: Annotated[
        float, typer.Option(help="Of the known pixels against the texture, at least 0.")
    ] = 10.0,
    offsets: Annotated[int, typer.Option(help="Shifts of the image that are offered.")] = 160,
    border: Annotated[
        float, typer.Option(help="Cost of a seam at the border of a hole, against 1 inside.")
    ] = 10.0,
    detail: Annotated[
        float, typer.Option(help="Cost of pixels from where the picture is flatter than around.")
    ] = 0.05,
    reach: Annotated[int, typer.Option(help="Pixels around a hole that are searched.")] = 256,
    plain: Plain = False,
    solver: Solver = None,
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
    """Fill holes in a picture from its own texture."""
    read = {image: exemplar_path(image), mask: Path(mask)}

    def make(watch: "Watch") -> "Montage":
        from torchtex import image as images
        from torchtex.recipes import fill as recipe

        chosen = solver_of(solver)
        picture = images.load(exemplar_path(image), name="image")
        hole = images.load_mask(mask, extent_of(picture.image), name="mask")
        if picture.mask is not None:  # what is transparent is not known either
            hole = hole | ~picture.mask
        return recipe.fill(
            picture.image,
            hole,
            confidence=confidence,
            offsets=offsets,
            border=border,
            detail=detail,
            reach=reach,
            poisson=not plain,
            solver=chosen,
            seed=seed,
            on_step=watch,
        )

    outputs = Outputs(output, bits, labels, report, patch_pictures(seams, patch_map))
    carry_out(context, outputs, read, make, threads=threads, keep_partial=keep_partial, quiet=quiet)


@app.command()
def mix(
    context: typer.Context,
    exemplar: Exemplars,
    output: Output,
    weights: Annotated[
        list[str],
        typer.Option(
            help="Map, black for the first exemplar and white for the second; or one map each, "
            "white where it is wanted."
        ),
    ],
    size: Annotated[
        str | None, typer.Option(help="HEIGHTxWIDTH in pixels; that of the map unless given.")
    ] = None,
    weight: Annotated[float, typer.Option(help="How closely the maps are followed.")] = 4.0,
    grain: Annotated[float, typer.Option(help="Size of the blobs in grey parts, pixels.")] = 12.0,
    mask: Masks = None,
    boundary: Boundary = "free",
    seed: Seed = 0,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> None:
    """Mix exemplars: one here, another there, both where a map is grey."""
    border = boundary_of(boundary)
    wanted = None if size is None else parse_size(size)
    read = read_files(exemplar, mask or ()) | {name: Path(name) for name in weights}

    def make(watch: "Watch") -> Any:
        from torchtex.recipes import mix as recipe

        exemplars, masks = load_exemplars(exemplar, mask or ())
        return recipe.mix(
            exemplars,
            _maps(weights, wanted),
            weight=weight,
            grain=grain,
            masks=masks,
            boundary=border,
            seed=seed,
            on_step=watch,
        )

    carry_out(
        context,
        Outputs(output, bits, labels, report),
        read,
        make,
        threads=threads,
        keep_partial=keep_partial,
        quiet=quiet,
    )


def _maps(names: list[str], size: tuple[int, int] | None) -> "torch.Tensor":
    """Grey values of the maps, all of one size."""
    import torch

    from torchtex import image as images

    maps: list[torch.Tensor] = []
    for name in names:
        grey = images.luminance(images.load(name, alpha=False, name="weights").image)
        if size is not None:
            grey = images.resize(grey[None], size)[0].clamp(0, 1)
        elif maps and grey.shape != maps[0].shape:
            raise ValueError(
                f"weights={name!r} has {grey.shape[0]}x{grey.shape[1]} pixels and the first map "
                f"{maps[0].shape[0]}x{maps[0].shape[1]}; make them the same size, or give --size"
            )
        maps.append(grey)
    return torch.stack(maps)
