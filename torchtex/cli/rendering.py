"""`torchtex render`: pictures of textures on things, of volumes and of meshes."""

import re
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import app
from torchtex.cli.files import choose, exemplar_path, parse_size
from torchtex.cli.marbling import Drawn
from torchtex.cli.options import Bits, Output, Quiet, Report, Threads
from torchtex.cli.recipe import Outputs, carry_out

if TYPE_CHECKING:
    from torchtex.cli.base import Watch
    from torchtex.render.views import Camera, Light

_UNUSED = {
    "texture": ("cut",),
    "plane": ("cut", "ground"),
    "mesh": ("object", "tiles", "normals", "ground", "cut"),
    "volume": ("object", "tiles", "normals", "ground", "gloss", "shadows"),
}
"""Options that change nothing of a picture of each kind."""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"


@app.command()
def render(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            help="A texture, or the name of a bundled exemplar; a volume (.npy, .nrrd, .vti, .zarr "
            "or a folder of slices); or a mesh (.obj, .ply, .glb) with its texture "
            "or the colours of its vertices."
        ),
    ],
    output: Output,
    object: Annotated[
        str,
        typer.Option(
            help="What a texture is shown on: sphere, torus, vase, cube, cylinder, cone, bowl, "
            "knot, plane, cloth, or a mesh.",
        ),
    ] = "sphere",
    tiles: Annotated[float, typer.Option(help="Tiles where there is one otherwise.")] = 1.0,
    normals: Annotated[
        float, typer.Option(help="Strength of a relief from lightness; below 0 dark is high.")
    ] = 0.0,
    ground: Annotated[
        str | None, typer.Option(help="Texture of a floor below; a picture or bundled exemplar.")
    ] = None,
    gloss: Annotated[float, typer.Option(help="Strength of the highlight.")] = 0.15,
    shadows: Annotated[bool, typer.Option(help="Throw shadows.")] = True,
    cut: Annotated[
        float, typer.Option(help="Of a volume, the share of each edge that is cut away, or 0.")
    ] = 0.5,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="AZIMUTH,ELEVATION[,DISTANCE]",
            help="Degrees, 0,0 is in front; one that suits the object unless given.",
        ),
    ] = None,
    light: Annotated[
        str,
        typer.Option(
            metavar="AZIMUTH,ELEVATION[,STRENGTH[,SKY]]",
            help="Where it comes from in degrees, how strong, and what comes from all around.",
        ),
    ] = "-35,50,0.85,0.3",
    size: Annotated[str, typer.Option(help="HEIGHTxWIDTH of the picture in pixels.")] = "512x512",
    samples: Annotated[int, typer.Option(help="Per pixel, squared; 1..8.")] = 3,
    threads: Threads = None,
    bits: Bits = 8,
    report: Report = None,
    quiet: Quiet = False,
) -> None:
    """Show a texture on a thing or on the ground, a volume as a block, or a mesh; in software."""
    from torchtex.meshes.files import READ
    from torchtex.meshes.shapes import SHAPES
    from torchtex.volumes.files import SUFFIXES

    wanted = parse_size(size)
    seen, lit = _camera(camera, object), _light(light)
    shape = Path(object)
    if shape.suffix.lower() not in READ:
        choose("object", object, tuple(SHAPES))
    if not 0 <= cut < 1:
        raise ValueError(f"cut={cut} must be at least 0 and below 1")
    path = exemplar_path(source)
    kind = "texture"
    if path.suffix.lower() in SUFFIXES or path.is_dir():
        kind = "volume"
    elif path.suffix.lower() in READ:
        kind = "mesh"
    _refuse_unused(context, "plane" if kind == "texture" and object == "plane" else kind)
    read = {source: path} if not path.is_dir() else {}
    if kind == "texture" and shape.suffix:
        read[object] = shape
    if kind == "texture" and ground is not None:
        read[ground] = exemplar_path(ground)

    def make(watch: "Watch") -> Any:
        from torchtex import image as images
        from torchtex.meshes.files import read_mesh
        from torchtex.meshes.placing import centred
        from torchtex.render import pictures
        from torchtex.volumes.files import load_volume

        started = time.perf_counter()
        if kind == "volume":
            drawn = pictures.volume_picture(
                load_volume(path, name="source"),
                cut=cut or None,
                camera=seen,
                light=lit,
                size=wanted,
                samples=samples,
            )
        elif kind == "mesh":
            drawn = pictures.mesh_picture(
                centred(read_mesh(path, name="source")),
                gloss=gloss,
                camera=seen,
                light=lit,
                size=wanted,
                shadows=shadows,
                samples=samples,
            )
        else:
            texture = images.load(path, alpha=False, name="source").image
            floor = None
            if ground is not None:
                floor = images.load(exemplar_path(ground), alpha=False, name="ground").image
            drawn = pictures.texture_picture(
                texture,
                centred(read_mesh(shape, name="object")) if shape.suffix else object,
                tiles=tiles,
                normals=normals,
                ground=floor,
                gloss=gloss,
                camera=seen,
                light=lit,
                size=wanted,
                shadows=shadows,
                samples=samples,
            )
        shown = object if kind == "texture" else kind
        settings = {"recipe": "render", "shows": shown}
        return Drawn(drawn, {"seconds": time.perf_counter() - started, "settings": settings})

    carry_out(
        context, Outputs(output, bits, None, report), read, make, threads=threads, quiet=quiet
    )


def _refuse_unused(context: typer.Context, kind: str) -> None:
    """Refuses what would change nothing."""
    defaults = {parameter.name: parameter.default for parameter in context.command.params}
    for name in _UNUSED[kind]:
        value = context.params[name]
        if value != defaults[name]:
            raise ValueError(f"{name}={value!r} changes nothing of a {kind}; leave it out")


def _camera(text: str | None, thing: str) -> "Camera | None":
    from torchtex.render.pictures import VIEWS
    from torchtex.render.views import Camera

    if text is None:
        return None
    found = _numbers("camera", text, 2, 3, "AZIMUTH,ELEVATION[,DISTANCE]")
    usual = VIEWS.get(thing, Camera())
    distance = found[2] if len(found) == 3 else usual.distance
    return replace(usual, azimuth=found[0], elevation=found[1], distance=distance)


def _light(text: str) -> "Light":
    from torchtex.render.views import Light

    found = _numbers("light", text, 2, 4, "AZIMUTH,ELEVATION[,STRENGTH[,SKY]]")
    return Light(found[0], found[1], *found[2:])


def _numbers(name: str, text: str, least: int, most: int, form: str) -> list[float]:
    parts = text.replace(" ", "").split(",")
    if not least <= len(parts) <= most or not all(re.fullmatch(_NUMBER, part) for part in parts):
        raise ValueError(f"{name}={text!r} must be {form}, numbers such as 30,20")
    return [float(part) for part in parts]
