"""`torchtex skeleton`: the coarse band synthesised, details copied along."""

import sys
from typing import TYPE_CHECKING, Annotated

import typer

from torchtex.cli.base import Watch, app
from torchtex.cli.files import (
    FEATURES,
    boundary_of,
    choose,
    feature_of,
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
    from typing import Any

    from torchtex.recipes.montage import Montage

LEVELS = 3


@app.command()
def skeleton(
    context: typer.Context,
    exemplar: Exemplars,
    output: Output,
    size: Size,
    levels: Annotated[
        int, typer.Option(help="How often the images are halved: 1, 2 or 3; more is faster.")
    ] = 1,
    wavelet: Annotated[
        str,
        typer.Option(
            help="Of the coarse band: haar, db2, ... With --no-mend, haar copies pixels and db2 "
            "blends them across seams; longer ones ring there."
        ),
    ] = "haar",
    phases: Annotated[
        int, typer.Option(help="Shifts of the exemplar along each axis to choose from: 1, 2, 4, 8.")
    ] = 1,
    feature: Annotated[
        str, typer.Option(help="What is compared in the coarse band: " + ", ".join(FEATURES))
    ] = "pixels",
    cut: Annotated[
        str, typer.Option(help="mincut moves seams to where they show least; none leaves them.")
    ] = "mincut",
    solver: Solver = None,
    mend: Annotated[
        bool,
        typer.Option(help="Match and average windows where pieces meet; all else is copied."),
    ] = True,
    refine: Annotated[
        int,
        typer.Option(help="Iterations of the optimisation at full size, after it; slower."),
    ] = 0,
    boundary: Boundary = "free",
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
    """Make a texture by synthesising only its coarse band; details are copied along."""
    extent, edge = parse_size(size), boundary_of(boundary)
    choose("feature", feature, FEATURES)
    choose("cut", cut, ("mincut", "none"))
    if not 1 <= levels <= LEVELS:
        raise ValueError(f"levels={levels} must lie in 1..{LEVELS}")
    if not 0 <= refine <= 100:
        raise ValueError(f"refine={refine} must lie in 0..100")
    if refine and (seams or patch_map):
        name = "seams" if seams else "patch_map"
        raise ValueError(f"{name} shows pieces, which refine={refine} averages; leave one out")
    chosen = solver_of(solver, cut)
    read = read_files(exemplar, mask or [])

    def make(watch: Watch) -> "Any":
        from torchtex.recipes import skeleton as skeletal

        zs, masks = load_exemplars(exemplar, mask or [])
        made = skeletal.skeleton(
            zs,
            extent,
            levels=levels,
            wavelet=wavelet,
            phases=phases,
            cut="none" if cut == "none" else "mincut",
            mend=mend,
            solver=chosen,
            feature=feature_of(feature),
            boundary=edge,
            masks=masks,
            seed=seed,
            on_step=watch,
        )
        if not quiet:
            _tell(made, exemplar)
        if not refine:
            return made
        return skeletal.refine(
            made, zs, steps=refine, boundary=edge, masks=masks, seed=seed, on_step=watch
        )

    outputs = Outputs(output, bits, labels, report, patch_pictures(seams, patch_map))
    carry_out(context, outputs, read, make, threads=threads, keep_partial=keep_partial, quiet=quiet)


def _tell(made: "Montage", names: list[str]) -> None:
    """What was padded or left out, since 2^levels does not divide it."""
    about = made.settings
    side = 2 ** about["levels"]
    size = [-(-n // side) * side for n in about["size"]]
    if size != about["size"]:
        given, padded = ("x".join(map(str, n)) for n in (about["size"], size))
        print(f"size={given} is made as {padded} and cropped", file=sys.stderr)
    for name, (rows, cols) in zip(names, about["unused"], strict=True):
        if rows or cols:
            print(
                f"exemplar={name!r}: the last {rows} rows and {cols} columns fill no block of "
                f"{side} pixels and are left out",
                file=sys.stderr,
            )
