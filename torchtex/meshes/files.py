"""Meshes as files: read by trimesh, and written by hand."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchtex import image as images
from torchtex.extras import needed
from torchtex.meshes.formats import from_linear, glb, mtl, obj, ply, png
from torchtex.meshes.mesh import Mesh, joined

READ = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
"""Endings of meshes that are read."""

WRITTEN = (".glb", ".ply", ".obj")
"""Endings of meshes that are written."""


def read_mesh(path: str | Path, *, name: str = "mesh") -> Mesh:
    """A mesh in its own coordinates, with the normals, colours and texture that the file gives.

    A file of points alone has no faces. Where a file has several parts, they are joined as they
    stand; their colours are kept if all have some, and a texture if it is the only part.

    Args:
        name: what an error calls `path`.

    Raises:
        ValueError: the file cannot be read, or holds no vertices.
        ImportError: trimesh is not installed, of the extra `solid`.

    Example:
        >>> read_mesh("bunny.blend")
        Traceback (most recent call last):
        ValueError: mesh='bunny.blend' must end in .ply, .obj, .glb, .gltf, .stl, .off
    """
    where = f"{name}={str(path)!r}"
    suffix = Path(path).suffix.lower()
    if suffix not in READ:
        raise ValueError(f"{where} must end in {', '.join(READ)}")
    if not Path(path).is_file():
        raise ValueError(f"{where}: there is no such file; check the name")
    trimesh = needed("trimesh", name)
    try:
        found = trimesh.load(str(path), process=False)
        linear = suffix in (".glb", ".gltf")
        parts = [_part(part, matrix, linear) for part, matrix in _placed(found)]
        if not parts:
            raise ValueError("it holds no vertices")
        return parts[0] if len(parts) == 1 else joined(_alike(parts))
    except Exception as error:  # the readers raise many types for damaged files
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{where} is no mesh that can be read ({reason})") from None


def _placed(found: Any) -> Iterator[tuple[Any, Tensor]]:
    """The meshes and points of a file, each with the matrix that puts it into its scene."""
    if not hasattr(found, "graph"):
        yield found, torch.eye(4, dtype=torch.float64)
        return
    for node in found.graph.nodes_geometry:
        matrix, name = found.graph[node]
        yield found.geometry[name], torch.tensor(np.array(matrix))


def _part(part: Any, matrix: Tensor, linear: bool) -> Mesh:
    """One of them where it stands; colours of its vertices may be amounts of light."""
    turn = matrix[:3, :3]
    points = torch.tensor(np.array(part.vertices)).double().reshape(-1, 3)
    vertices = (points @ turn.T + matrix[:3, 3]).float()
    if not len(getattr(part, "faces", ())):
        return Mesh(vertices, torch.zeros(0, 3, dtype=torch.long), colors=_colors(part, linear))
    faces = torch.tensor(np.array(part.faces)).long().reshape(-1, 3)
    up = torch.tensor(np.array(part.vertex_normals)).double() @ torch.linalg.inv(turn)
    faces = faces.flip(1) if float(torch.linalg.det(turn)) < 0 else faces
    mesh = Mesh(vertices, faces, normals=torch.nn.functional.normalize(up, dim=1).float())
    at = getattr(part.visual, "uv", None)
    if at is None or len(at) != len(vertices):
        return replace(mesh, colors=_colors(part, linear))
    across, upward = torch.tensor(np.array(at)).float()[:, :2].unbind(1)
    texture = _texture(part.visual.material)
    colors = _colors(part, linear) if texture is None else None
    return replace(mesh, uv=torch.stack([1 - upward, across], 1), colors=colors, texture=texture)


def _colors(part: Any, linear: bool) -> Tensor | None:
    """sRGB colours of the vertices, if a file gives any."""
    given = getattr(part.visual, "vertex_attributes", {}).get("color")
    if given is None and part.visual.kind == "vertex":
        given = part.visual.vertex_colors
    if given is None or np.shape(given)[:1] != (len(part.vertices),):
        return None
    values = np.array(given)[:, :3]
    most = np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1
    colors = torch.tensor(values.astype(np.float32) / most).clamp(0, 1)
    return from_linear(colors) if linear else colors


def _texture(material: Any) -> Tensor | None:
    """The picture that a material of trimesh holds, if it does."""
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if picture is None or min(picture.size) < 2:
        return None
    return torch.from_numpy(np.array(picture.convert("RGB"))).permute(2, 0, 1).float() / 255


def _alike(parts: list[Mesh]) -> list[Mesh]:
    """Parts that have the same kinds of values; points get no normals, and none gets others'."""
    plain = []
    painted = all(part.colors is not None for part in parts)
    for part in parts:
        up = torch.zeros_like(part.vertices) if part.normals is None else part.normals
        colors = part.colors if painted else None
        plain.append(Mesh(part.vertices, part.faces, normals=up, colors=colors))
    return plain


def save_mesh(path: str | Path, mesh: Mesh, *, name: str = "output") -> None:
    """Writes a mesh with its texture, or with the colours of its vertices; whole or not at all.

    Args:
        path: .glb, .ply or .obj. A .glb holds its texture; beside an .obj with one there are an
            .mtl and a .png, see `companions`.
        name: what an error calls `path`.

    Raises:
        ValueError: as `check_mesh_path`.

    Example:
        >>> import tempfile
        >>> flat = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]), colors=torch.eye(3))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_mesh(f"{folder}/flat.ply", flat)
        ...     Path(folder, "flat.ply").read_bytes()[:3]
        b'ply'
    """
    baked = mesh.texture is not None and mesh.uv is not None
    check_mesh_path(path, baked=baked, points=not len(mesh.faces), name=name)
    suffix = Path(path).suffix.lower()
    files: dict[Path, bytes] = {}
    if suffix == ".obj" and mesh.texture is not None and mesh.uv is not None:
        material, picture = companions(path)
        files = {picture: png(mesh.texture), material: mtl(picture.name)}
        files[Path(path)] = obj(mesh, material.name)
    else:
        files[Path(path)] = {".glb": glb, ".ply": ply, ".obj": obj}[suffix](mesh)
    for target, content in files.items():
        with images.atomic_write(target, name=name) as temporary:
            temporary.write_bytes(content)


def companions(path: str | Path) -> tuple[Path, Path]:
    """The files of the material and of the texture that are written with an .obj.

    Example:
        >>> [file.name for file in companions("ring.obj")]
        ['ring.mtl', 'ring_texture.png']
    """
    target = Path(path)
    return target.with_suffix(".mtl"), target.with_name(f"{target.stem}_texture.png")


def check_mesh_path(
    path: str | Path, *, baked: bool = False, points: bool = False, name: str = "output"
) -> None:
    """Refuses, before any work, a name that a mesh cannot be written to.

    Args:
        baked: whether it has a texture.
        points: whether it has no faces.
        name: what an error calls `path`.

    Raises:
        ValueError: another ending, one that cannot hold this, or no such folder.

    Example:
        >>> check_mesh_path("carved.stl")
        Traceback (most recent call last):
        ValueError: output='carved.stl' must end in .glb, .ply or .obj
    """
    suffix, where = Path(path).suffix.lower(), f"{name}={str(path)!r}"
    if suffix not in WRITTEN:
        raise ValueError(f"{where} must end in .glb, .ply or .obj")
    if baked and suffix == ".ply":
        raise ValueError(f"{where} cannot hold a texture; name a .glb or .obj, or leave bake out")
    if points and suffix == ".obj":
        raise ValueError(f"{where} cannot hold coloured points; name a .glb or .ply")
    images.check_writable(path, suffixes=WRITTEN, name=name)
    if baked and suffix == ".obj":
        for companion in companions(path):
            images.check_writable(companion, suffixes=(companion.suffix,), name=name)
