"""`torchtex carve`: meshes with the colours of a volume."""

import json
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import app
from torchtex.cli.files import check_outputs, hint, sha256
from torchtex.cli.options import Quiet, Report
from torchtex.cli.recipe import kept_options

if TYPE_CHECKING:
    from torchtex.meshes.mesh import Mesh

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"


@app.command()
def carve(
    context: typer.Context,
    volume: Annotated[
        str, typer.Argument(help="A .npy, .nrrd, .vti or .zarr, or a folder of slices.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help=".glb, .ply or .obj to write.")],
    mesh: Annotated[
        str,
        typer.Option(
            help="A .ply, .obj, .glb, .gltf, .stl or .off, or sphere, torus, vase, cube, cylinder, "
            "cone, bowl, knot, cloth."
        ),
    ] = "sphere",
    scale: Annotated[
        float, typer.Option(help="How often the volume fits along the longest side of the mesh.")
    ] = 1.0,
    shift: Annotated[
        str,
        typer.Option(metavar="DEPTH,ROW,COLUMN", help="Voxels by which the volume is moved."),
    ] = "0,0,0",
    detail: Annotated[
        float, typer.Option(help="Longest edge of the triangles, in voxels; without --bake.")
    ] = 1.0,
    bake: Annotated[
        int | None,
        typer.Option(
            help="Side of a texture in pixels that holds the colours; unless given, they are at "
            "the vertices of small triangles."
        ),
    ] = None,
    report: Report = None,
    quiet: Quiet = False,
) -> None:
    """Give a mesh the colours that a volume has where its surface passes through."""
    import torchtex
    from torchtex import image as images
    from torchtex.meshes.files import WRITTEN, check_mesh_path, companions, save_mesh
    from torchtex.volumes import carve as carving
    from torchtex.volumes.files import load_volume

    began = time.perf_counter()
    moved = _shift(shift)
    read = {volume: Path(volume)}
    if Path(mesh).suffix:
        read[mesh] = Path(mesh)
    beside = companions(output) if bake is not None and output.suffix.lower() == ".obj" else ()
    check_outputs(
        (
            ("output", output, WRITTEN),
            ("report", report, (".json",)),
            *(("output", path, (path.suffix,)) for path in beside),
        ),
        read.values(),
    )
    check_mesh_path(output, baked=bake is not None)
    surface = _surface(mesh)
    points = not len(surface.faces)
    check_mesh_path(output, baked=bake is not None, points=points)
    voxels = load_volume(volume)
    made = carving.carve(voxels, surface, scale=scale, shift=moved, detail=detail, bake=bake)
    save_mesh(output, made)
    if not quiet and points:
        print(f"mesh={mesh!r} has no faces; its points are coloured", file=sys.stderr)
    elif not quiet and not surface.closed:
        print(f"mesh={mesh!r} is not watertight; it is carved as it is", file=sys.stderr)
    if report is not None:
        about: dict[str, Any] = {
            "version": torchtex.__version__,
            "command": context.info_name,
            "options": kept_options(context),
            "files": {name: sha256(path) for name, path in read.items() if path.is_file()},
            "seconds": time.perf_counter() - began,
            "settings": {
                "recipe": "carve",
                "volume": list(voxels.shape),
                "vertices": len(made.vertices),
                "faces": len(made.faces),
                "watertight": surface.closed,
            },
        }
        with images.atomic_write(report, name="report") as temporary:
            temporary.write_text(json.dumps(about, indent=2) + "\n")
    print(output)


def _surface(name: str) -> "Mesh":
    """A mesh from a file, or a built-in one."""
    from torchtex.meshes.files import read_mesh
    from torchtex.meshes.shapes import SHAPES

    if Path(name).suffix:
        return read_mesh(name)
    shapes = [known for known in SHAPES if known != "plane"]
    if name not in shapes:
        raise ValueError(
            f"mesh={name!r} is no built-in mesh and no file of one; {hint(name, shapes)}"
        )
    return SHAPES[name]()


def _shift(text: str) -> tuple[float, float, float]:
    parts = text.replace(" ", "").split(",")
    if len(parts) != 3 or not all(re.fullmatch(_NUMBER, part) for part in parts):
        raise ValueError(f"shift={text!r} must be DEPTH,ROW,COLUMN in voxels, such as 0,12,4.5")
    depth, row, column = (float(part) for part in parts)
    return depth, row, column
