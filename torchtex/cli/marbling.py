"""`torchtex marble`: a texture marbled by tines, waves, circles, vortices and drops of ink."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import app
from torchtex.cli.files import boundary_of, exemplar_path, parse_size
from torchtex.cli.options import Bits, Boundary, ExemplarName, Output, Quiet, Report, Threads
from torchtex.cli.recipe import Outputs, carry_out

if TYPE_CHECKING:
    import torch

    from torchtex.cli.base import Watch
    from torchtex.layers.tines import Operation


@dataclass(frozen=True)
class Drawn:
    """A picture with what is said about it.

    Args:
        texture: the picture.
        about: plain values, for the report and the file.
    """

    texture: "torch.Tensor"
    about: dict[str, Any]

    def report(self) -> dict[str, Any]:
        """Settings and timing as plain values."""
        return self.about


@app.command()
def marble(
    context: typer.Context,
    texture: ExemplarName,
    output: Output,
    op: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME:VALUES",
            help="tine, comb, wave, circle, vortex or drop, with values such as "
            "tine:angle=45,shift=0.2,width=0.05 or drop:row=0.3,column=0.6,radius=0.1,"
            "color=#203060; shares of the texture, and degrees. One after another.",
        ),
    ] = None,
    operations: Annotated[
        Path | None,
        typer.Option(
            help='JSON: [{"operation": "comb", "tines": 6, "angle": 90}, ...]; done before --op.'
        ),
    ] = None,
    undo: Annotated[
        bool, typer.Option("--undo", help="Take back what the same operations did.")
    ] = False,
    boundary: Boundary = "free",
    size: Annotated[
        str | None, typer.Option(help="HEIGHTxWIDTH in pixels; that of TEXTURE unless given.")
    ] = None,
    samples: Annotated[
        int, typer.Option(help="Readings a pixel, squared, where the paint is drawn out; 1..16.")
    ] = 4,
    degree: Annotated[
        int, typer.Option(help="Of the splines that the texture is read through: 1, 3, 5 or 7.")
    ] = 3,
    threads: Threads = None,
    bits: Bits = 8,
    report: Report = None,
    quiet: Quiet = False,
) -> None:
    """Marble a texture: draw tines through it, stir it, drop ink on it. Tiles stay tiles."""
    from torchtex.layers.marbling_words import load_operations, parse_operation

    periodic = boundary_of(boundary) == "periodic"
    wanted = None if size is None else parse_size(size)
    design: list[Operation] = [] if operations is None else load_operations(operations)
    design += [parse_operation(text) for text in op or ()]
    if not design:
        raise ValueError("op: none given; repeat --op NAME:VALUES or give --operations FILE")
    read = {texture: exemplar_path(texture)}
    if operations is not None:
        read[str(operations)] = operations

    def make(watch: "Watch") -> Any:
        from torchtex import image as images
        from torchtex.layers.marbling import marble as draw
        from torchtex.layers.marbling_words import as_json, with_channels

        started = time.perf_counter()
        picture = images.load(exemplar_path(texture), alpha=False, name="texture").image
        fitted = [with_channels(operation, len(picture)) for operation in design]
        drawn = draw(
            picture,
            fitted,
            periodic=periodic,
            undo=undo,
            size=wanted,
            samples=samples,
            degree=degree,
        )
        settings = {
            "recipe": "marble",
            "operations": [as_json(operation) for operation in design],
            "periodic": periodic,
            "undo": undo,
            "samples": samples,
            "degree": degree,
        }
        return Drawn(drawn, {"seconds": time.perf_counter() - started, "settings": settings})

    carry_out(
        context, Outputs(output, bits, None, report), read, make, threads=threads, quiet=quiet
    )
