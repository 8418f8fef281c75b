"""`torchtex cyclic`, `torchtex wang` and `torchtex wang-tile`: textures and sets that tile."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import app
from torchtex.cli.files import choose, cut_of, exemplar_path, parse_size, solver_of
from torchtex.cli.options import (
    Bits,
    Cut,
    ExemplarName,
    KeepPartial,
    Labels,
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
    from torchtex.recipes.wang import WangSet


@app.command()
def cyclic(
    context: typer.Context,
    texture: Annotated[str, typer.Argument(help="The picture that is to tile.")],
    output: Output,
    overlap: Annotated[
        str,
        typer.Option(help="HEIGHTxWIDTH that is laid over and lost, or best to search for it."),
    ] = "best",
    cut: Cut = "mincut",
    solver: Solver = None,
    opening: Annotated[
        str, typer.Option(help="Where the border lies: best (least visible) or half.")
    ] = "best",
    poisson: Annotated[
        bool, typer.Option("--poisson", help="Spread what is left of steps at the seams.")
    ] = False,
    preview: Annotated[
        str | None, typer.Option(help="ROWSxCOLUMNS; writes OUT_3x3 for 3x3, the tiling.")
    ] = None,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    seams: SeamPicture = None,
    patch_map: PatchPicture = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> None:
    """Make a texture tile: cut seams between its opposite sides. Transparency is dropped.

    The result is smaller than TEXTURE by the overlap.
    """
    from torchtex import image as images

    way, chosen = cut_of(cut), solver_of(solver, cut)
    choose("opening", opening, ("best", "half"))
    lost = None if overlap == "best" else _overlap(overlap)
    rows, columns = (1, 1) if preview is None else _preview(preview)
    shown = output.with_name(f"{output.stem}_{rows}x{columns}{output.suffix}")
    path = exemplar_path(texture)
    picture = images.load(path, alpha=False, name="texture").image

    def make(watch: Any) -> "Montage":
        from torchtex.recipes.cyclic import BestOverlap
        from torchtex.recipes.cyclic import cyclic as run

        return run(
            picture,
            overlap=BestOverlap() if lost is None else lost,
            cut=way,
            solver=chosen,
            opening="half" if opening == "half" else "best",
            poisson=poisson,
            on_step=watch,
        )

    pictures = patch_pictures(seams, patch_map)
    pictures.append(
        (
            "preview",
            None if preview is None else shown,
            lambda r: r.texture.repeat(1, rows, columns),
        )
    )
    carry_out(
        context, Outputs(output, bits, labels, report, pictures), {texture: path}, make,
        threads=threads, keep_partial=keep_partial, quiet=quiet,
    )  # fmt: skip


@app.command()
def wang(
    context: typer.Context,
    exemplar: ExemplarName,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="PNG of all tiles; .json is written beside it.")
    ],
    colors: Annotated[int, typer.Option(help="Of edges, 2 or 3 for each direction.")] = 2,
    tile: Annotated[int, typer.Option(help="Side of a tile in pixels, even.")] = 64,
    complete: Annotated[
        bool, typer.Option("--complete", help="All tiles, 16 or 81, rather than 8 or 18.")
    ] = False,
    cut: Cut = "mincut",
    solver: Solver = None,
    seed: Seed = 0,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    seams: SeamPicture = None,
    patch_map: PatchPicture = None,
    quiet: Quiet = False,
) -> None:
    """Cut a set of Wang tiles from an exemplar, for `torchtex wang-tile`.

    Transparent pixels are not used.
    """
    from torchtex import image as images
    from torchtex.recipes.wang import edges_path

    way, chosen = cut_of(cut), solver_of(solver, cut)
    images.check_writable(output, suffixes=(".png",), name="output")
    path = exemplar_path(exemplar)
    picture = images.load(path, name="exemplar")
    made: list[WangSet] = []

    def make(watch: Any) -> "Montage":
        from torchtex.recipes.wang import wang_tiles

        found = wang_tiles(
            picture.image,
            colors=colors,
            tile=tile,
            complete=complete,
            cut=way,
            solver=chosen,
            mask=picture.mask,
            seed=seed,
            on_step=watch,
        )
        made.append(found)
        return found.sheet()

    outputs = Outputs(
        output, bits, labels, report, patch_pictures(seams, patch_map),
        [("edges", edges_path(output), lambda _: made[0].save_edges(output, bits=bits))],
    )  # fmt: skip
    carry_out(context, outputs, {exemplar: path}, make, threads=threads, quiet=quiet)


@app.command("wang-tile")
def wang_tile(
    context: typer.Context,
    atlas: Annotated[str, typer.Argument(help="What `torchtex wang` wrote; .json beside it.")],
    output: Output,
    size: Size,
    seed: Seed = 0,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    seams: SeamPicture = None,
    patch_map: PatchPicture = None,
    quiet: Quiet = False,
) -> None:
    """Lay Wang tiles at random, so that their edges match, to a texture of any size."""
    from torchtex.recipes.wang import WangSet, edges_path

    extent = parse_size(size)
    found = WangSet.load(atlas)
    carry_out(
        context,
        Outputs(output, bits, labels, report, patch_pictures(seams, patch_map)),
        {atlas: Path(atlas), str(edges_path(atlas)): edges_path(atlas)},
        lambda watch: found.tile(extent, seed),
        threads=threads,
        quiet=quiet,
    )


def _overlap(text: str) -> tuple[int, int]:
    try:
        return parse_size(text, "overlap")
    except ValueError:
        raise ValueError(
            f"overlap={text!r} must be best, or HEIGHTxWIDTH in pixels, such as 64x64"
        ) from None


def _preview(text: str) -> tuple[int, int]:
    rows, columns = parse_size(text, "preview")
    if max(rows, columns) > 16:
        raise ValueError(f"preview={text!r} may have at most 16 tiles a side, such as 3x3")
    return rows, columns
