"""`torchtex carve`: meshes with the colours of a volume."""

import re
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import Watch, app
from torchtex.cli.files import check_outputs, hint
from torchtex.cli.options import Quiet, Report, Threads
from torchtex.cli.recipe import carry_out, write_report

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
    threads: Threads = None,
    report: Report = None,
    quiet: Quiet = False,
) -> None:
    """Give a mesh the colours that a volume has where its surface passes through."""
    from torchtex.meshes.files import check_mesh_path
    from torchtex.volumes import carve as carving
    from torchtex.volumes.files import load_volume

    moved = _shift(shift)
    read = {volume: Path(volume)} if Path(volume).is_file() else {}
    if Path(mesh).suffix:
        read[mesh] = Path(mesh)
    outputs = Meshes(output, bake is not None, report)

    def make(watch: Watch) -> _Carved:
        began = time.perf_counter()
        surface = _surface(mesh)
        points = not len(surface.faces)
        check_mesh_path(output, baked=bake is not None, points=points)
        voxels = load_volume(volume)
        made = carving.carve(voxels, surface, scale=scale, shift=moved, detail=detail, bake=bake)
        if not quiet and points:
            print(f"mesh={mesh!r} has no faces; its points are coloured", file=sys.stderr)
        elif not quiet and not surface.closed:
            print(f"mesh={mesh!r} is not watertight; it is carved as it is", file=sys.stderr)
        settings = {
            "recipe": "carve", "volume": list(voxels.shape), "vertices": len(made.vertices),
            "faces": len(made.faces), "watertight": surface.closed,
        }  # fmt: skip
        return _Carved(made, {"seconds": time.perf_counter() - began, "settings": settings})

    carry_out(context, outputs, read, make, threads=threads, quiet=True)


@dataclass(frozen=True)
class _Carved:
    """A carved mesh, with what is said about it."""

    mesh: "Mesh"
    about: dict[str, Any]

    def report(self) -> dict[str, Any]:
        return self.about


@dataclass(frozen=True)
class Meshes:
    """What a run that makes a mesh writes.

    Args:
        output: the mesh.
        baked: whether it has a texture.
        report: .json, or None.
    """

    output: Path
    baked: bool
    report: Path | None = None

    def check(self, read: Mapping[str, Path]) -> None:
        """Refuses, before work starts, what cannot be written."""
        from torchtex.meshes.files import WRITTEN, check_mesh_path, companions

        beside = self.baked and self.output.suffix.lower() == ".obj"
        check_outputs(
            (
                ("output", self.output, WRITTEN),
                ("report", self.report, (".json",)),
                *(("output", path, ()) for path in (companions(self.output) if beside else ())),
            ),
            read.values(),
        )
        check_mesh_path(self.output, baked=self.baked)

    def write(self, result: _Carved, about: dict[str, Any]) -> None:
        """Writes all of it."""
        from torchtex.meshes.files import save_mesh

        save_mesh(self.output, result.mesh)
        write_report(self.report, about)

    def write_partial(self, progress: Any, about: dict[str, Any]) -> None:
        """Nothing: a mesh is carved in one step."""


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
