"""`torchtex complete` and `torchtex design`: holes filled patch by patch, and new textures."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from torchtex.cli.base import Watch, app, progress_bar
from torchtex.cli.files import (
    choose,
    exemplar_path,
    extent_of,
    load_exemplars,
    parse_size,
    read_files,
    same_channels,
    solver_of,
)
from torchtex.cli.layers import (
    Flip,
    Layers,
    Methods,
    Mirror,
    load_scribbles,
    method_of,
    numbered,
    spread_of,
)
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
from torchtex.cli.recipe import Outputs, carry_out, described, kept_options, patch_pictures

if TYPE_CHECKING:
    from torchtex.layers.plans import Plan
    from torchtex.recipes.design_parts import Enlarge
    from torchtex.recipes.montage import Montage

SEARCHES = ("exhaustive", "fft", "qtp")

Patch = Annotated[int, typer.Option(help="Side of the patches that fill holes, in pixels.")]
Order = Annotated[
    str, typer.Option(help="scan: row by row, or confidence: where most is known first.")
]
Searches = Annotated[
    str, typer.Option(help="For patches: fft or exhaustive, all places, or qtp, coarse to fine.")
]


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
    how, which, chosen = _order(order), _search(search), solver_of(solver)
    read = {name: exemplar_path(name) for name in (image, *(source or []))} | {mask: Path(mask)}

    def make(watch: Watch) -> "Montage":
        from torchtex import image as images
        from torchtex.recipes import completion as recipe

        whole = images.load(exemplar_path(image), alpha=False, name="image").image
        holes = images.load_mask(mask, extent_of(whole), name="mask")
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
            poisson=not plain,
            solver=chosen,
            seed=seed,
            on_step=watch,
        )

    outputs = Outputs(output, bits, labels, report, patch_pictures(seams, patch_map))
    carry_out(context, outputs, read, make, threads=threads, keep_partial=keep_partial, quiet=quiet)


@app.command()
def design(
    context: typer.Context,
    output: Output,
    exemplar: Annotated[
        list[str] | None,
        typer.Argument(help="Pictures, or names of bundled exemplars; layers of all are mixed."),
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
        str | None, typer.Option(help="JSON of operations for every piece; with --textures 1.")
    ] = None,
    chaos: Annotated[str, typer.Option(help="Map: logistic, tent or henon.")] = "logistic",
    combined: Annotated[int, typer.Option(help="Different operations on one layer.")] = 2,
    iterations: Annotated[int, typer.Option(help="How often layers are deformed.")] = 1,
    rotate: Annotated[str | None, typer.Option(help="Turn whole exemplars, as -180:180.")] = None,
    scale: Annotated[str | None, typer.Option(help="Scale whole exemplars, as 0.8:1.25.")] = None,
    mirror: Mirror = 0.0,
    flip: Flip = 0.0,
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

        run_file(context, Path(recipe), output, cache, only, names, bits, threads, quiet)
        return
    if cache is not None or only is not None:
        raise ValueError("cache and only are for --recipe; leave them out")
    if not names:
        raise ValueError("exemplar: none given; name at least one picture, or give --recipe FILE")
    if count < 1 or workers < 1:
        raise ValueError(f"count={count} and workers={workers} must be at least 1")
    extent, way, kind = parse_size(size), method_of(method), _enlarge(enlarge)
    how, which = _order(order), _search(search)
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
    from torchtex.recipes.design_parts import Layering
    from torchtex.recipes.layered import Filling

    layering = Layering(
        layers, way, Chaos(chaos, combined, iterations), _plan(plan),
        filling=Filling(patch, how, which),
    )  # fmt: skip

    def made(count: int, watch: Watch) -> "list[Montage]":
        from torchtex.recipes import design as recipes

        zs, masks = load_exemplars(names, [])
        if any(mask is not None for mask in masks):
            raise ValueError("exemplar is transparent in places; give one that is not, or cut it")
        segmentations = None
        if scribbles:
            segmentations = _scribbled(zs, scribbles)
        return recipes.designs(
            zs, extent, count, layering=layering, segmentations=segmentations, spread=spread,
            textures=textures, enlarge=kind, cyclic_overlap=cyclic, poisson=poisson, seed=seed,
            workers=workers, on_step=watch,
        )  # fmt: skip

    if count == 1:
        outputs = Outputs(output, bits, labels, report, patch_pictures(seams, patch_map))
        carry_out(context, outputs, read, lambda watch: made(1, watch)[0], threads=threads,
                  keep_partial=keep_partial, quiet=quiet)  # fmt: skip
        return
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
        return Outputs(numbered(output, number), bits, named["labels"], named["report"], pictures)

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


def _scribbled(zs: Any, scribbles: list[str]) -> Any:
    from torchtex.layers.segment import segment

    return [
        segment(z, scribbles=load_scribbles(name, extent_of(z)))
        for z, name in zip(zs, scribbles, strict=True)
    ]


def _plan(name: str | None) -> "Plan | None":
    if name is None:
        return None
    from torchtex import image as images
    from torchtex.layers.plans import Plan

    try:
        value = json.loads(images.read_bytes(name, name="plan"))
    except ValueError as error:
        if "plan=" in str(error):
            raise
        raise ValueError(f"plan={name!r} is no JSON ({error})") from None
    return Plan.read(value.get("plan", value) if isinstance(value, dict) else value)


def _order(name: str) -> Literal["scan", "confidence"]:
    choose("order", name, ("scan", "confidence"))
    return "confidence" if name == "confidence" else "scan"


def _search(name: str) -> Literal["exhaustive", "fft", "qtp"]:
    choose("search", name, SEARCHES)
    return "qtp" if name == "qtp" else "exhaustive" if name == "exhaustive" else "fft"


def _enlarge(name: str) -> "Enlarge":
    choose("enlarge", name, ("graphcut", "wavelet", "layers"))
    return "wavelet" if name == "wavelet" else "layers" if name == "layers" else "graphcut"
