"""`torchtex deform` and `torchtex segment`: pictures moved and turned, or taken apart in layers."""

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import Watch, app
from torchtex.cli.files import check_output, choose, exemplar_path, extent_of
from torchtex.cli.options import (
    Bits,
    ExemplarName,
    Labels,
    Output,
    PatchPicture,
    Quiet,
    Report,
    Seed,
    Threads,
)
from torchtex.cli.recipe import Outputs, carry_out

if TYPE_CHECKING:
    import torch

    from torchtex.layers.deform import Spread
    from torchtex.layers.segment import Method
    from torchtex.recipes.montage import Montage

MOST_SCRIBBLES = 64
_NUMBER = r"[-+]?(?:\d{1,9}(?:\.\d*)?|\.\d+)"

Rotate = Annotated[
    str, typer.Option(help="Degrees counter-clockwise, or LEAST:MOST to draw from, as -30:30.")
]
Scale = Annotated[str, typer.Option(help="Factor, or LEAST:MOST to draw from, as 0.8:1.25.")]
Rows = Annotated[str, typer.Option(help="Pixels down, or LEAST:MOST to draw from.")]
Cols = Annotated[str, typer.Option(help="Pixels to the right, or LEAST:MOST to draw from.")]
Mirror = Annotated[float, typer.Option(help="Probability that left and right change places.")]
Flip = Annotated[float, typer.Option(help="Probability that above and below change places.")]
Layers = Annotated[int, typer.Option(help="How many layers of like colours.")]
Methods = Annotated[
    str, typer.Option(help="graph: how pixels differ from their neighbours; meanshift: colours.")
]


@app.command()
def deform(
    context: typer.Context,
    exemplar: ExemplarName,
    output: Output,
    rows: Rows = "0",
    cols: Cols = "0",
    rotate: Rotate = "0",
    scale: Scale = "1",
    mirror: Mirror = 0.0,
    flip: Flip = 0.0,
    complete: Annotated[
        bool, typer.Option("--complete", help="Fill what is left open from the picture.")
    ] = False,
    seed: Seed = 0,
    threads: Threads = None,
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    quiet: Quiet = False,
) -> None:
    """Move, turn, mirror and scale a picture; what lies outside of it becomes transparent."""
    spread = spread_of(rows, cols, rotate, scale, mirror, flip)
    read = {exemplar: exemplar_path(exemplar)}

    def make(watch: Watch) -> "Montage":
        import torch

        from torchtex import image as images
        from torchtex.inputs import check_seed
        from torchtex.layers.deform import deform as deformed
        from torchtex.recipes.design_parts import whole_deformed
        from torchtex.recipes.layered import Filling
        from torchtex.recipes.montage import Montage

        check_seed(seed)
        started = time.perf_counter()
        loaded = images.load(exemplar_path(exemplar), name="exemplar")
        drawn = spread.draw(torch.Generator().manual_seed(seed))
        settings = {"recipe": "deform", "deformation": vars(drawn), "complete": complete}
        if complete:
            if loaded.mask is not None:
                raise ValueError("complete: the exemplar is transparent in places; give all of it")
            made = whole_deformed([loaded.image], 0, drawn, Filling(), seed)
            texture, field, patches = made.texture, made.field, made.patches
        else:
            done = deformed(loaded.image, drawn, mask=loaded.mask)
            texture, field, patches = done.texture, done.field, done.mask.long()
            if output.suffix.lower() not in (".jpg", ".jpeg"):  # which has no transparency
                texture = torch.cat([texture, done.mask[None].to(texture)])
        return Montage(texture, field, patches, time.perf_counter() - started, seed, settings)

    carry_out(context, Outputs(output, bits, labels, report), read, make, threads=threads,
              quiet=quiet)  # fmt: skip


@app.command()
def segment(
    context: typer.Context,
    exemplar: ExemplarName,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Map of the layers to write, in flat colours.")
    ],
    layers: Layers = 3,
    method: Methods = "graph",
    smooth: Annotated[float, typer.Option(help="Sigma in pixels of a blur before.")] = 1.0,
    smallest: Annotated[
        int | None, typer.Option(help="Pixels of the smallest piece; else a 400th of all.")
    ] = None,
    scribbles: Annotated[
        str | None,
        typer.Option(help="Marks on black, one flat colour for each layer; instead of --layers."),
    ] = None,
    mask: Annotated[
        list[str] | None,
        typer.Option(help="White in a layer; repeat it, what none covers is one layer more."),
    ] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(help="NAME.png: layers to write as NAME_1.png, NAME_2.png, ..., transparent "
                     "around them."),
    ] = None,
    patch_map: PatchPicture = None,
    threads: Threads = None,
    report: Report = None,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Take a texture apart into layers of like colours. --patch-map shows their child layers."""
    way = method_of(method)
    if scribbles is not None and mask:
        raise ValueError("scribbles and mask both name layers; give one of them")
    read = {exemplar: exemplar_path(exemplar)} | {
        name: Path(name) for name in (scribbles, *(mask or [])) if name is not None
    }
    if pictures is not None:
        check_output(numbered(pictures, 1), read.values(), "pictures", (".png", ".tif", ".tiff"))
    made: list[tuple[Any, Any]] = []

    def make(watch: Watch) -> "Montage":
        from torchtex import image as images
        from torchtex.layers.segment import segment as segmented
        from torchtex.recipes.montage import Montage, color_labels
        from torchtex.sources import copied, pixel_places

        started = time.perf_counter()
        image = images.load(exemplar_path(exemplar), alpha=False, name="exemplar").image
        size = extent_of(image)
        found = segmented(
            image,
            layers,
            method=way,
            smooth=smooth,
            smallest=smallest,
            scribbles=None if scribbles is None else load_scribbles(scribbles, size),
            masks=[images.load_mask(name, size, name="mask") for name in mask or []],
        )
        made.append((found, image))
        places = pixel_places(size)
        positions = places.new_zeros(*size, 3)
        positions[..., 1:] = places
        settings = {"recipe": "segment", "method": method, "layers": [
            {"pixels": int(found.mask(n).sum()), "children": len(found.children_of(n))}
            for n in range(found.count)]}  # fmt: skip
        field, seconds = copied(positions, [size]), time.perf_counter() - started
        return Montage(color_labels(found.labels), field, found.children, seconds, 0, settings)

    def save(path: Path) -> None:
        from torchtex import image as images

        found, image = made[-1]
        for layer in range(found.count):
            file = numbered(path, layer + 1)
            images.save(file, found.picture(image, layer), name="pictures")

    outputs = Outputs(
        output,
        report=report,
        pictures=[("patch_map", patch_map, lambda result: result.patch_picture())],
        files=[("pictures", pictures, save)],
    )
    carry_out(context, outputs, read, make, threads=threads, quiet=quiet)


def spread_of(
    rows: str, cols: str, rotate: str, scale: str, mirror: float, flip: float
) -> "Spread":
    """Ranges of deformations, from the texts of options."""
    spans = [
        parse_range(text, name)
        for name, text in (("rows", rows), ("cols", cols), ("rotate", rotate), ("scale", scale))
    ]
    from torchtex.layers.deform import Spread

    return Spread(spans[0], spans[1], spans[2], spans[3], mirror, flip)


def parse_range(text: str, name: str) -> tuple[float, float]:
    """A number, or two with a colon between them.

    Example:
        >>> parse_range("-30:30", "rotate"), parse_range("1.5", "scale")
        ((-30.0, 30.0), (1.5, 1.5))
    """
    found = re.fullmatch(rf"({_NUMBER})(?::({_NUMBER}))?", text.strip())
    if found is None:
        raise ValueError(f"{name}={text!r} must be a number or LEAST:MOST, such as -30:30")
    low = float(found[1])
    return low, low if found[2] is None else float(found[2])


def method_of(name: str) -> "Method":
    """The way of segmenting of that name."""
    choose("method", name, ("graph", "meanshift"))
    return "graph" if name == "graph" else "meanshift"


def numbered(path: Path, number: int) -> Path:
    """A file name with a number.

    Example:
        >>> numbered(Path("a/layer.png"), 2).as_posix()
        'a/layer_2.png'
    """
    return path.with_name(f"{path.stem}_{number}{path.suffix}")


def load_scribbles(path: str, size: tuple[int, int]) -> "torch.Tensor":
    """Layers by the flat colours of a picture, in the order of their first pixels; -1 for black.

    Raises:
        ValueError: another size, or more colours than can be meant.
    """
    import torch

    from torchtex import image as images

    loaded = images.load(path, name="scribbles")
    if extent_of(loaded.image) != size:
        found = extent_of(loaded.image)
        raise ValueError(
            f"scribbles={path!r} has {found[0]} x {found[1]} pixels (rows x columns), its picture "
            f"{size[0]} x {size[1]}; make them the same size"
        )
    marked = loaded.image.amax(0) > 0
    if loaded.mask is not None:
        marked &= loaded.mask
    colours, which = loaded.image[:, marked].unique(dim=1, return_inverse=True)
    count = colours.shape[1]
    if count > MOST_SCRIBBLES:
        raise ValueError(
            f"scribbles={path!r} has {count} colours; draw each layer in one flat colour, "
            "and save it as PNG"
        )
    first = torch.full((count,), len(which)).scatter_reduce(
        0, which, torch.arange(len(which)), "amin"
    )
    layers = torch.full(size, -1)
    layers[marked] = first.argsort().argsort()[which]
    return layers
