"""`torchtex quilt` and `torchtex patchwise`: square patches of the exemplar side by side."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchtex.cli.base import Watch, app
from torchtex.cli.files import (
    choose,
    cut_of,
    load_exemplars,
    parse_size,
    read_files,
    solver_of,
)
from torchtex.cli.options import (
    Bits,
    Cut,
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
    from torchtex.recipes.montage import Montage

SEARCHES = ("exhaustive", "fft", "qtp")

Overlap = Annotated[
    int | None,
    typer.Option(help="Pixels that neighbors share; a sixth of their side unless given."),
]


@app.command()
def quilt(
    context: typer.Context,
    exemplar: Exemplars,
    output: Output,
    size: Annotated[
        str | None, typer.Option(help="HEIGHTxWIDTH of the texture in pixels; not with --target.")
    ] = None,
    block: Annotated[
        int | None,
        typer.Option(
            help="Side of a block in pixels; unless given, 0.28 of the exemplar's, with --target "
            "half of that."
        ),
    ] = None,
    overlap: Overlap = None,
    tolerance: Annotated[
        float, typer.Option(help="How much dearer than the best a drawn block may be; 0.1: 10%.")
    ] = 0.1,
    cut: Cut = "dp",
    solver: Solver = None,
    continuing: Annotated[
        bool,
        typer.Option("--continuing", help="Also let blocks go on where a neighbor ends."),
    ] = False,
    target: Annotated[
        str | None, typer.Option(help="Picture to render in the exemplar's texture.")
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Passes with ever smaller blocks, of --target; 3.")
    ] = None,
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
    """Make a texture of blocks joined along best seams, or render a target in such blocks."""
    extent = _extent(size, target, iterations, continuing)
    way, chosen = cut_of(cut), solver_of(solver, cut)
    read = read_files(exemplar, mask or [])
    if target is not None:
        read[target] = Path(target)

    def make(watch: Watch) -> "Montage":
        from torchtex import image as images
        from torchtex.recipes import quilting

        zs, masks = load_exemplars(exemplar, mask or [])
        if target is None:
            return quilting.quilt(
                zs,
                extent,
                block=block,
                overlap=overlap,
                tolerance=tolerance,
                cut=way,
                solver=chosen,
                continuing=continuing,
                masks=masks,
                seed=seed,
                on_step=watch,
            )
        return quilting.transfer(
            zs,
            images.load(target, alpha=False, name="target").image,
            block=block,
            overlap=overlap,
            iterations=3 if iterations is None else iterations,
            tolerance=tolerance,
            cut=way,
            solver=chosen,
            masks=masks,
            seed=seed,
            on_step=watch,
        )

    outputs = Outputs(output, bits, labels, report, patch_pictures(seams, patch_map))
    carry_out(context, outputs, read, make, threads=threads, keep_partial=keep_partial, quiet=quiet)


@app.command()
def patchwise(
    context: typer.Context,
    exemplar: Exemplars,
    output: Output,
    size: Size,
    patch: Annotated[
        int | None,
        typer.Option(help="Side of a patch in pixels; 0.28 of the exemplar's unless given."),
    ] = None,
    overlap: Overlap = None,
    tolerance: Annotated[
        float, typer.Option(help="Relative distance up to which a patch fits.")
    ] = 0.1,
    search: Annotated[
        str, typer.Option(help="exhaustive, fft (the same, sooner), or qtp, approximate.")
    ] = "fft",
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
    """Make a texture of patches whose borders fit, blended where they overlap."""
    extent = parse_size(size)
    choose("search", search, SEARCHES)
    read = read_files(exemplar, mask or [])

    def make(watch: Watch) -> "Montage":
        from torchtex.recipes import patchwise as recipe

        zs, masks = load_exemplars(exemplar, mask or [])
        return recipe.patchwise(
            zs,
            extent,
            patch=patch,
            overlap=overlap,
            tolerance=tolerance,
            search="qtp" if search == "qtp" else "fft" if search == "fft" else "exhaustive",
            masks=masks,
            seed=seed,
            on_step=watch,
        )

    outputs = Outputs(output, bits, labels, report, patch_pictures(seams, patch_map))
    carry_out(context, outputs, read, make, threads=threads, keep_partial=keep_partial, quiet=quiet)


def _extent(
    size: str | None, target: str | None, iterations: int | None, continuing: bool
) -> tuple[int, int]:
    """The size; (1, 1) with a target, which has one of its own."""
    if target is None:
        if iterations is not None:
            raise ValueError(f"iterations={iterations} needs --target; leave it out, or give one")
        if size is None:
            raise ValueError("size: none given; give --size HEIGHTxWIDTH, or --target")
        return parse_size(size)
    if size is not None:
        raise ValueError(f"size={size!r}: the texture is as large as --target; leave --size out")
    if continuing:
        raise ValueError("continuing does not go with --target; leave one of them out")
    return 1, 1
