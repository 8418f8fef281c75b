"""`torchtex apply`: other maps with the labels of a texture."""

import json
from pathlib import Path
from typing import Annotated

import typer

from torchtex.cli.base import app
from torchtex.cli.files import bits_of, check_output, holds, same_channels
from torchtex.cli.options import Output


@app.command()
def apply(
    labels: Annotated[Path, typer.Argument(help="An .npz that --labels wrote.")],
    maps: Annotated[
        list[Path],
        typer.Argument(metavar="MAP...", help="Maps aligned with the exemplars, one for each."),
    ],
    output: Output,
    bits: Annotated[
        int | None, typer.Option(help="8 or 16; unless given, as many as the map and file allow.")
    ] = None,
) -> None:
    """Render other maps of the same exemplars (normals, height, ...) with the same labels.

    Transparency is dropped.
    """
    import torchtex
    from torchtex import image as images
    from torchtex.labels import load_field

    check_output(output, [*maps, labels])
    label_field = load_field(labels)
    loaded = [images.load(path, alpha=False, name="map").image for path in maps]
    for path, values in zip(maps, loaded, strict=True):
        low, high = float(values.min()), float(values.max())
        if low < 0 or high > 1:
            raise ValueError(
                f"map={str(path)!r} has values from {low:g} to {high:g}, which a picture cannot "
                "hold; scale them to 0..1"
            )
    loaded = same_channels(loaded)
    if bits is None:
        deep = max(bits_of(path) for path in maps) == 16
        bits = 16 if deep and holds(output, len(loaded[0]), 16) else 8
    elif bits not in (8, 16) or not holds(output, len(loaded[0]), bits):
        raise ValueError(f"bits={bits} cannot be saved as {output.suffix}; use --bits 8, or .png")
    texture = label_field.apply(loaded)
    about = {
        "version": torchtex.__version__,
        "command": "apply",
        "options": {"labels": str(labels), "maps": [str(path) for path in maps], "bits": bits},
    }
    images.save(output, texture, bits=bits, metadata={"torchtex": json.dumps(about)}, name="output")
    print(output)
