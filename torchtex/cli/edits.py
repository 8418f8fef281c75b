"""`torchtex edit` and `torchtex blend`: pieces of one picture put into another."""

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchtex.cli.base import app
from torchtex.cli.files import (
    choose,
    exemplar_path,
    extent_of,
    same_channels,
    solver_of,
)
from torchtex.cli.marks import marks_in, written_mark
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
    Solver,
    Threads,
)
from torchtex.cli.recipe import Outputs, carry_out, patch_pictures

if TYPE_CHECKING:
    from torchtex.cli.base import Watch
    from torchtex.recipes.montage import Montage


@app.command()
def edit(
    context: typer.Context,
    base: Base,
    output: Output,
    reference: Annotated[
        str | None, typer.Option(help="Where the strokes are painted; the base unless given.")
    ] = None,
    stroke: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MASK:ROW,COL[:ROTATION[:SCALE]]",
            help="A rough mark, white on black, of the reference's size; rows and columns that it "
            "moves; degrees counter-clockwise. Grey leaves it open what is the object's.",
        ),
    ] = None,
    strokes: Annotated[
        Path | None,
        typer.Option(
            help='JSON: [{"mask": file, "offset": [row, col], "rotation": 0, "scale": 1, '
            '"mirror": false}, ...]; instead of a mask "path": [[row, col], ...] with "radius", '
            '"circles": [[row, col, radius], ...] or "polygon": [[row, col], ...].'
        ),
    ] = None,
    data_cost: Annotated[
        float, typer.Option(help="Cost per marked pixel that does not show the reference.")
    ] = 1e6,
    k1: Annotated[float, typer.Option(help="Weight of colours in the cost of a seam.")] = 0.5,
    k2: Annotated[float, typer.Option(help="Weight of gradients in the cost of a seam.")] = 0.5,
    band: Annotated[
        int | None,
        typer.Option(
            help="Pixels around a mark that the cut decides on; by its size unless given."
        ),
    ] = None,
    objects: Annotated[
        bool, typer.Option(help="Keep objects whole, or use the paper's energy as it is.")
    ] = True,
    plain: Plain = False,
    solver: Solver = None,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    seams: SeamPicture = None,
    patch_map: PatchPicture = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> None:
    """Put what rough strokes mark in a reference into a picture, whole and without a seam."""
    marks = [written_mark(text) for text in stroke or ()]
    if strokes is not None:
        marks += marks_in(strokes)
    if not marks:
        raise ValueError("stroke: none given; repeat --stroke MASK:ROW,COL or give --strokes FILE")
    chosen = solver_of(solver)
    read = {name: exemplar_path(name) for name in (base, reference) if name is not None}
    if strokes is not None:
        read[str(strokes)] = strokes
    read |= {mark.mask: Path(mark.mask) for mark in marks if mark.mask is not None}

    def make(watch: "Watch") -> "Montage":
        from torchtex import image as images
        from torchtex.recipes import local_edit

        pictures = [images.load(exemplar_path(base), alpha=False, name="base").image]
        usable = None
        if reference is not None:
            loaded = images.load(exemplar_path(reference), name="reference")
            pictures, usable = [*pictures, loaded.image], loaded.mask
        pictures = same_channels(pictures)
        return local_edit.edit(
            pictures[0],
            [mark.stroke(pictures[-1]) for mark in marks],
            reference=None if reference is None else pictures[1],
            reference_mask=usable,
            data_cost=data_cost,
            k1=k1,
            k2=k2,
            band=band,
            objects=local_edit.Objects() if objects else None,
            poisson=not plain,
            solver=chosen,
            on_step=watch,
        )

    outputs = Outputs(output, bits, labels, report, patch_pictures(seams, patch_map))
    carry_out(context, outputs, read, make, threads=threads, keep_partial=keep_partial, quiet=quiet)


@app.command()
def blend(
    context: typer.Context,
    base: Base,
    source: Annotated[str, typer.Argument(help="The picture a piece is taken from.")],
    output: Output,
    mask: Annotated[
        str | None,
        typer.Option(help="White where SOURCE is cloned; all that is opaque unless given."),
    ] = None,
    offset: Annotated[
        str, typer.Option(help="ROW,COL in BASE of the first pixel of SOURCE; may be negative.")
    ] = "0,0",
    mixed: Annotated[
        bool, typer.Option("--mixed", help="Keep the stronger gradient of the two pictures.")
    ] = False,
    boundary: Annotated[
        str, typer.Option(help="At the border of BASE: free, or dirichlet to refuse a piece there.")
    ] = "free",
    plain: Plain = False,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    seams: SeamPicture = None,
    patch_map: PatchPicture = None,
    quiet: Quiet = False,
) -> None:
    """Clone a piece of a picture into another, with the colours of what is around it."""
    choose("boundary", boundary, ("free", "dirichlet"))
    found = re.fullmatch(r"([-+]?\d{1,9}),([-+]?\d{1,9})", offset)
    if found is None:
        raise ValueError(f"offset={offset!r} is not ROW,COL; write it like 12,-40")
    place = int(found[1]), int(found[2])
    read = {name: exemplar_path(name) for name in (base, source)}
    if mask is not None:
        read[mask] = Path(mask)

    def make(watch: "Watch") -> "Montage":
        import torch

        from torchtex import image as images
        from torchtex.recipes import blend as recipe

        started = time.perf_counter()
        loaded = images.load(exemplar_path(source), name="source")
        whole = images.load(exemplar_path(base), alpha=False, name="base").image
        below, above = same_channels([whole, loaded.image])
        size = extent_of(above)
        piece = torch.ones(size, dtype=torch.bool) if loaded.mask is None else loaded.mask
        if mask is not None:
            piece = piece & images.load_mask(mask, size, name="mask")
        done = recipe.blend(
            below,
            above,
            piece,
            place,
            mixed=mixed,
            boundary="free" if boundary == "free" else "dirichlet",
        )
        return recipe.blended_montage(
            done, size, place, poisson=not plain, seconds=time.perf_counter() - started
        )

    outputs = Outputs(output, bits, labels, report, patch_pictures(seams, patch_map))
    carry_out(context, outputs, read, make, threads=threads, quiet=quiet)
