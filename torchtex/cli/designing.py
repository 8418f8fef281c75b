"""`torchtex design`: new textures from deformed layers."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import Watch, app, progress_bar
from torchtex.cli.design_options import (
    PLANS,
    Order,
    Patch,
    Searches,
    enlarge_of,
    order_of,
    scribbled,
    search_of,
)
from torchtex.cli.files import load_exemplars, parse_size, read_files
from torchtex.cli.layers import Flip, Layers, Methods, Mirror, method_of, numbered, spread_of
from torchtex.cli.options import (
    Bits,
    KeepPartial,
    Labels,
    Output,
    PatchPicture,
    Quiet,
    Report,
    SeamPicture,
    Seed,
    Threads,
)
from torchtex.cli.recipe import Outputs, carry_out, described, kept_options, patch_pictures

if TYPE_CHECKING:
    from torchtex.recipes.montage import Montage


@app.command()
def design(
    context: typer.Context,
    output: Output,
    exemplar: Annotated[
        list[str] | None,
        typer.Argument(help="Pictures, or names of bundled exemplars; of unlike ones some may "
                       "hardly be seen: --enlarge layers mixes more."),
    ] = None,
    recipe: Annotated[
        str | None,
        typer.Option(help="YAML or JSON file of stages; instead of exemplars and options."),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder that keeps what stages of --recipe made, to go on from there."),
    ] = None,
    only: Annotated[
        int | None, typer.Option(help="Number of the one design of --recipe that is written.")
    ] = None,
    size: Annotated[str, typer.Option(help="HEIGHTxWIDTH of the texture in pixels.")] = "256x256",
    count: Annotated[
        int, typer.Option(help="How many, of seeds one after another, written as NAME_1.png, ...")
    ] = 1,
    layers: Layers = 3,
    method: Methods = "graph",
    scribbles: Annotated[
        list[str] | None,
        typer.Option(help="Layers of each exemplar: marks on black, one flat colour each."),
    ] = None,
    textures: Annotated[
        int, typer.Option(help="Deformed textures that the large one is made from.")
    ] = 3,
    enlarge: Annotated[
        str,
        typer.Option(help="graphcut: patches of them; wavelet: energy of windows; layers: layers "
                     "laid over all of it at once."),
    ] = "graphcut",
    cyclic: Annotated[
        int | None, typer.Option(help="Make it tile, by seams in an overlap of so many pixels.")
    ] = None,
    plan: Annotated[
        str | None,
        typer.Option(help="Operations for every piece: a --report, perhaps edited, or its list of "
                     "them with --textures 1."),
    ] = None,
    chaos: Annotated[str, typer.Option(help="Map: logistic, tent or henon.")] = "logistic",
    combined: Annotated[int, typer.Option(help="Different operations on one layer.")] = 2,
    iterations: Annotated[int, typer.Option(help="How often layers are deformed.")] = 1,
    rotate: Annotated[str | None, typer.Option(help="Turn whole exemplars, as -180:180.")] = None,
    scale: Annotated[str | None, typer.Option(help="Scale whole exemplars, as 0.8:1.25.")] = None,
    mirror: Mirror = 0.0,
    flip: Flip = 0.0,
    variety: Annotated[
        float, typer.Option(help="How much a design prefers some parts to others; 0: all alike.")
    ] = 0.9,
    upright: Annotated[
        bool, typer.Option("--upright", help="Mend seams with pieces that are not turned.")
    ] = False,
    mend: Annotated[
        int | None, typer.Option(help="Places whose seams are mended; else as many as suit.")
    ] = None,
    patch: Patch = 32,
    order: Order = "scan",
    search: Searches = "fft",
    poisson: Annotated[bool, typer.Option("--poisson", help="Even out levels at seams.")] = False,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(help="Processes for --count; changes no pixel.")] = 2,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    seams: SeamPicture = None,
    patch_map: PatchPicture = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Design new textures: layers of the exemplars, deformed and put together otherwise."""
    names = exemplar or []
    if recipe is not None:
        from torchtex.cli.design_files import run_file

        run_file(context, Path(recipe), output, report, cache, only, names, bits, threads, quiet)
        return
    if cache is not None or only is not None:
        raise ValueError("cache and only are for --recipe; leave them out")
    if not names:
        raise ValueError("exemplar: none given; name at least one picture, or give --recipe FILE")
    if count < 1 or workers < 1:
        raise ValueError(f"count={count} and workers={workers} must be at least 1")
    extent, way, kind = parse_size(size), method_of(method), enlarge_of(enlarge)
    how, which = order_of(order), search_of(search)
    if scribbles and len(scribbles) != len(names):
        raise ValueError(
            f"scribbles: {len(scribbles)} given for {len(names)} exemplars; give one each"
        )
    read = read_files(names, []) | {name: Path(name) for name in scribbles or []}
    if plan is not None:
        read[plan] = Path(plan)
    spread = None
    if rotate is not None or scale is not None or mirror or flip:
        spread = spread_of("0", "0", rotate or "0", scale or "1", mirror, flip)
    from torchtex.layers.plans import Chaos
    from torchtex.recipes.design_file import read_plans
    from torchtex.recipes.design_parts import Layering
    from torchtex.recipes.layered import Filling
    from torchtex.recipes.mending import Mending

    layering = Layering(
        layers, way, Chaos(chaos, combined, iterations), () if plan is None else read_plans(plan),
        filling=Filling(patch, how, which), mending=Mending(mend, turns=not upright),
        variety=variety,
    )  # fmt: skip

    def made(count: int, watch: Watch) -> "list[Montage]":
        from torchtex.recipes import design as recipes

        zs, masks = load_exemplars(names, [])
        if any(mask is not None for mask in masks):
            raise ValueError("exemplar is transparent in places; give one that is not, or cut it")
        segmentations = None
        if scribbles:
            segmentations = scribbled(zs, scribbles)
        return recipes.designs(
            zs, extent, count, layering=layering, segmentations=segmentations, spread=spread,
            textures=textures, enlarge=kind, cyclic_overlap=cyclic, poisson=poisson, seed=seed,
            workers=workers, on_step=watch,
        )  # fmt: skip

    if count == 1:
        pictures = patch_pictures(seams, patch_map)
        outputs = Outputs(output, bits, labels, report, pictures, lengthy=PLANS)
        carry_out(context, outputs, read, lambda watch: made(1, watch)[0], threads=threads,
                  keep_partial=keep_partial, quiet=quiet)  # fmt: skip
        return
    if keep_partial:
        raise ValueError(
            f"keep_partial is for one design and count={count}; leave it out, or make one of them"
        )
    _several(context, output, count, bits, read, made, threads, quiet,
             (labels, report, seams, patch_map))  # fmt: skip


def _several(
    context: typer.Context, output: Path, count: int, bits: int, read: dict[str, Path],
    made: Any, threads: int | None, quiet: bool, others: tuple[Path | None, ...],
) -> None:  # fmt: skip
    """Writes many designs, each with the options that make it alone."""
    names = ("labels", "report", "seams", "patch_map")

    def outputs(number: int) -> Outputs:
        named = {n: None if p is None else numbered(p, number)
                 for n, p in zip(names, others, strict=True)}  # fmt: skip
        pictures = patch_pictures(named["seams"], named["patch_map"])
        return Outputs(numbered(output, number), bits, named["labels"], named["report"], pictures,
                       lengthy=PLANS)  # fmt: skip

    for number in range(1, count + 1):
        outputs(number).check(read)
    import torch

    if threads is not None:
        torch.set_num_threads(threads)
    with progress_bar(quiet) as watch:
        results = made(count, watch)
    options = kept_options(context)
    for number, result in enumerate(results, 1):
        about = described(context, read, options | {"count": 1, "seed": result.seed})
        outputs(number).write(result, about | result.report())
        print(numbered(output, number))
