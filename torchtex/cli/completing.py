"""`torchtex complete`: holes filled patch by patch."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchtex.cli.base import Watch, app
from torchtex.cli.design_options import Order, Patch, Searches, order_of, search_of
from torchtex.cli.files import exemplar_path, extent_of, same_channels, solver_of
from torchtex.cli.options import (
    Base,
    Bits,
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
    from torchtex.recipes.montage import Montage


@app.command()
def complete(
    context: typer.Context,
    image: Base,
    output: Output,
    mask: Annotated[str, typer.Option(help="White in the holes, of the size of the image.")],
    source: Annotated[
        list[str] | None,
        typer.Option(help="Where patches come from, repeated for several; else the image."),
    ] = None,
    patch: Patch = 32,
    order: Order = "scan",
    search: Searches = "fft",
    tolerance: Annotated[
        float, typer.Option(help="How much dearer than the best a drawn patch may be; 0.1: 10%.")
    ] = 0.0,
    rim: Annotated[
        int, typer.Option(help="Pixels around holes that patches may replace for better seams.")
    ] = 8,
    apart: Annotated[
        int, typer.Option(help="Least pixels from a source's own place, in one of the same size.")
    ] = 0,
    fresh: Annotated[
        float, typer.Option(help="How much dearer a patch is that was all used once; 2: 3 times.")
    ] = 2.0,
    detail: Annotated[
        float, typer.Option(help="How much dearer a patch is with more or less detail than usual.")
    ] = 2.0,
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
    """Complete holes with patches of the picture, or of sources, joined by min-cuts."""
    how, which, chosen = order_of(order), search_of(search), solver_of(solver)
    read = {name: exemplar_path(name) for name in (image, *(source or []))} | {mask: Path(mask)}

    def make(watch: Watch) -> "Montage":
        from torchtex import image as images
        from torchtex.recipes import completion as recipe

        whole = images.load(exemplar_path(image), alpha=False, name="image").image
        holes = images.load_mask(mask, extent_of(whole), name="mask")
        if not source and patch > min(extent_of(whole)):  # sources may be larger
            raise ValueError(
                f"patch={patch} is larger than the shorter side of the image, "
                f"{min(extent_of(whole))} pixels; choose a smaller one"
            )
        loaded = [images.load(exemplar_path(name), name="source") for name in source or []]
        whole, *sources = same_channels([whole, *(item.image for item in loaded)])
        return recipe.complete(
            whole,
            holes,
            source=sources or None,
            source_masks=[item.mask for item in loaded] or None,
            patch=patch,
            order=how,
            search=which,
            tolerance=tolerance,
            rim=rim,
            apart=apart,
            fresh=fresh,
            detail=detail,
            poisson=not plain,
            solver=chosen,
            seed=seed,
            on_step=watch,
        )

    outputs = Outputs(output, bits, labels, report, patch_pictures(seams, patch_map))
    carry_out(context, outputs, read, make, threads=threads, keep_partial=keep_partial, quiet=quiet)
