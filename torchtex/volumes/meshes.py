"""Meshes for carving: read and written by trimesh, divided into small triangles, laid out flat."""

import math
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex import image as images
from torchtex.extras import needed

READ = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
"""Endings of meshes that are read."""

WRITTEN = (".glb", ".ply", ".obj")
"""Endings of meshes that are written."""

_WELD = 1e5  # steps along the longest side, within which vertices are one
_GAP = 4  # texels of a cell's side that its two triangles leave free


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles, or points alone.

    Args:
        vertices: places in space.
        faces: numbers of the vertices of every triangle; none for points.
        normals: of every vertex.

    Raises:
        ValueError: no vertices, values that are not finite, or faces without their vertices.

    Example:
        >>> Surface(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(3, 3)).closed
        False
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "m 3"]
    normals: Float[Tensor, "v 3"]

    def __post_init__(self) -> None:
        count = len(self.vertices)
        if not count:
            raise ValueError("mesh has no vertices; give one with a surface, or points")
        if not bool(self.vertices.isfinite().all()):
            raise ValueError("mesh has vertices that are NaN or infinite; repair it")
        if len(self.faces) and not 0 <= int(self.faces.min()) <= int(self.faces.max()) < count:
            raise ValueError(f"mesh has faces with vertices outside 0..{count - 1}; repair it")

    @property
    def closed(self) -> bool:
        """True when every edge has a triangle on both sides; vertices at one place are one."""
        if not len(self.faces):
            return False
        low = self.vertices.amin(0)
        extent = (self.vertices - low).max().clamp(min=1e-30)
        cells = ((self.vertices - low).double() / extent * _WELD).round().long()
        number = torch.unique(cells, dim=0, return_inverse=True)[1]
        corners = number[self.faces]
        flat = (corners == corners.roll(1, 1)).any(1)  # such as at the poles of a sphere
        first = corners[~flat].flatten()
        second = corners[~flat].roll(-1, 1).flatten()
        n = len(self.vertices)
        there = torch.unique(first * n + second, return_counts=True)
        back = torch.unique(second * n + first, return_counts=True)
        return bool(len(there[0])) and all(map(torch.equal, there, back))


def read_mesh(path: str | Path, *, name: str = "mesh") -> Surface:
    """A mesh in its own coordinates; a file of points alone has no faces.

    Args:
        name: what an error calls `path`.

    Raises:
        ValueError: the file cannot be read, or holds nothing that can be carved.
        ImportError: trimesh is not installed, of the extra `solid`.

    Example:
        >>> read_mesh("bunny.blend")
        Traceback (most recent call last):
        ValueError: mesh='bunny.blend' must end in .ply, .obj, .glb, .gltf, .stl, .off
    """
    where = f"{name}={str(path)!r}"
    if Path(path).suffix.lower() not in READ:
        raise ValueError(f"{where} must end in {', '.join(READ)}")
    if not Path(path).is_file():
        raise ValueError(f"{where}: there is no such file; check the name")
    trimesh = needed("trimesh", name)
    try:
        return _joined(_parts(trimesh.load(str(path), process=False)))
    except Exception as error:  # the readers raise many types for damaged files
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{where} is no mesh that can be read ({reason})") from None


def _parts(found: Any) -> list[tuple[Any, Tensor]]:
    """The meshes and points of a file, each with the matrix that puts it into its scene."""
    if not hasattr(found, "graph"):
        return [(found, torch.eye(4, dtype=torch.float64))]
    placed = [found.graph[node] for node in found.graph.nodes_geometry]
    return [(found.geometry[name], torch.tensor(np.array(matrix))) for matrix, name in placed]


def _joined(parts: list[tuple[Any, Tensor]]) -> Surface:
    """One mesh of several; trimesh would lose the normals that the file gives."""
    vertices, faces, normals, first = [], [], [], 0
    for part, matrix in parts:
        turn = matrix[:3, :3]
        points = torch.tensor(np.array(part.vertices)).double().reshape(-1, 3)
        vertices.append((points @ turn.T + matrix[:3, 3]).float())
        index, up = torch.zeros(0, 3, dtype=torch.long), torch.zeros_like(points)
        if len(getattr(part, "faces", ())):
            index = torch.tensor(np.array(part.faces)).long().reshape(-1, 3)
            up = torch.tensor(np.array(part.vertex_normals)).double() @ torch.linalg.inv(turn)
            index = index.flip(1) if float(torch.linalg.det(turn)) < 0 else index
        faces.append(index + first)
        normals.append(torch.nn.functional.normalize(up, dim=1).float())
        first += len(points)
    if not first:
        raise ValueError("it holds no vertices")
    return Surface(torch.cat(vertices), torch.cat(faces), torch.cat(normals))


def subdivide(surface: Surface, longest: float, *, most: int = 4_000_000) -> Surface:
    """The same surface in triangles whose edges are at most so long.

    Edges that are too long are halved, for both of their triangles alike, so no cracks open.

    Args:
        longest: edge, in the units of the vertices.
        most: triangles that may be made.

    Raises:
        ValueError: more triangles would be needed.

    Example:
        >>> flat = Surface(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(3, 3))
        >>> len(subdivide(flat, 1.0).faces)
        4
    """
    values = torch.cat([surface.vertices, surface.normals], 1)
    faces = surface.faces
    while True:
        first, second = faces.flatten(), faces.roll(-1, 1).flatten()
        low, high = torch.minimum(first, second), torch.maximum(first, second)
        key, place = torch.unique(low * len(values) + high, return_inverse=True)
        ends = torch.stack([key // len(values), key % len(values)], 1)
        length = (values[ends[:, 0], :3] - values[ends[:, 1], :3]).norm(dim=1)
        long = length > longest * (1 + 1e-6)
        if not bool(long.any()):
            break
        if len(faces) + 2 * int(long.sum()) > most:
            raise ValueError(
                f"detail: more than {most} triangles would be needed for this mesh; "
                "choose a larger detail or a smaller scale, or bake a texture"
            )
        number = torch.full((len(key),), -1)
        number[long] = len(values) + torch.arange(int(long.sum()))
        values = torch.cat([values, values[ends[long]].mean(1)])
        faces = _split(faces, number[place].view(-1, 3))
    normals = torch.nn.functional.normalize(values[:, 3:], dim=1)
    return Surface(values[:, :3].contiguous(), faces, normals)


def _split(faces: Tensor, middles: Tensor) -> Tensor:
    """Triangles cut at the middles of some edges; -1 where an edge stays whole."""
    cut = middles >= 0
    count = cut.sum(1)
    # turned so that with one cut it is the first edge, and with two it is not the first
    turn = torch.where(count == 1, cut.long().argmax(1), (~cut).long().argmax(1))
    order = (turn[:, None] + torch.arange(3)) % 3
    a, b, c = faces.gather(1, order).unbind(1)
    ab, bc, ca = middles.gather(1, order).unbind(1)
    patterns = {
        0: ((a, b, c),),
        1: ((a, ab, c), (ab, b, c)),
        2: ((a, b, bc), (a, bc, ca), (ca, bc, c)),
        3: ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)),
    }
    parts = [
        torch.stack(corners, 1)[count == cuts]
        for cuts, triangles in patterns.items()
        for corners in triangles
    ]
    return torch.cat(parts)


@dataclass(frozen=True, eq=False)
class Atlas:
    """Triangles laid out on a square texture, two in each of its cells.

    Args:
        surface: with vertices of its own for every triangle, in order.
        places: row and column of every vertex on the texture, in texels.
        face: which triangle every texel belongs to.
        shares: of the triangle's corners in every texel; beyond its sides some are below 0.
    """

    surface: Surface
    places: Float[Tensor, "v 2"]
    face: Int[Tensor, "s s"]
    shares: Float[Tensor, "s s 3"]

    def points(self) -> Float[Tensor, "n 3"]:
        """The place in space of every texel, row by row."""
        corners = self.surface.vertices.view(-1, 3, 3)[self.face.flatten()]
        return (corners * self.shares.view(-1, 3, 1)).sum(1)


def atlas(surface: Surface, size: int) -> Atlas:
    """The layout of a mesh on a texture of size x size texels.

    All triangles are equally large on it, whatever they are in space. Texels around a triangle go
    on in its plane, so that reading between texels finds no other colour.

    Raises:
        ValueError: no triangles, or a texture that is too small for them.

    Example:
        >>> flat = Surface(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(3, 3))
        >>> atlas(flat, 16).points().shape
        torch.Size([256, 3])
    """
    count = len(surface.faces)
    if not count:
        raise ValueError("bake: the mesh has no faces; leave bake out to colour its points")
    across = math.ceil(math.sqrt(math.ceil(count / 2)))
    side = size // across
    if side <= _GAP + 1:
        raise ValueError(
            f"bake={size} is too small for {count} triangles; choose at least "
            f"{across * (_GAP + 4)}, or leave it out for colours at vertices"
        )
    s = float(side)
    lower = torch.tensor([[1.0, 1.0], [1.0, s - 3], [s - 3, 1.0]])
    corners = torch.stack([lower, s - lower])
    number = torch.arange(count)
    cell = number // 2
    origin = side * torch.stack([cell // across, cell % across], 1)
    places = corners[number % 2] + origin[:, None]
    line = torch.arange(size)
    cells, inside = (line // side).clamp(max=across - 1), (line % side) + 0.5
    inside = torch.where(line >= side * across, s - 0.5, inside)
    row, col = inside[:, None].expand(size, size), inside[None].expand(size, size)
    upper = row + col > s
    face = 2 * (cells[:, None] * across + cells[None]) + upper
    row, col = torch.where(upper, s - row, row), torch.where(upper, s - col, col)
    b, c = (col - 1) / (s - 4), (row - 1) / (s - 4)
    shares = torch.stack([1 - b - c, b, c], -1)
    index = surface.faces.flatten()
    own = Surface(
        surface.vertices[index], torch.arange(len(index)).view(-1, 3), surface.normals[index]
    )
    return Atlas(own, places.view(-1, 2), face.clamp(max=count - 1), shares)


def save_mesh(
    path: str | Path,
    surface: Surface,
    *,
    colors: Float[Tensor, "v 3"] | None = None,
    texture: Float[Tensor, "3 h w"] | None = None,
    places: Float[Tensor, "v 2"] | None = None,
    name: str = "output",
) -> None:
    """Writes a mesh with colours at its vertices, or with a texture; whole or not at all.

    Args:
        path: .glb, .ply or .obj; with a texture, .glb, which holds it.
        colors: of every vertex, in [0, 1].
        texture: in [0, 1].
        places: of every vertex on the texture: row and column in its pixels.
        name: what an error calls `path`.

    Raises:
        ValueError: as `check_mesh_path`.
        ImportError: trimesh is not installed, of the extra `solid`.
    """
    check_mesh_path(path, baked=texture is not None, points=not len(surface.faces), name=name)
    trimesh = needed("trimesh", name)
    suffix = Path(path).suffix.lower().lstrip(".")
    vertices = surface.vertices.double().numpy()
    made: Any
    shades = None if colors is None else _bytes(colors)
    if not len(surface.faces):
        made = trimesh.PointCloud(vertices, colors=shades)
    else:
        baked = None
        if texture is not None and places is not None:
            baked = _textured(texture, places)
        made = trimesh.Trimesh(
            vertices, surface.faces.numpy(), process=False, visual=baked, vertex_colors=shades,
            vertex_normals=surface.normals.double().numpy(),
        )  # fmt: skip
    if suffix == "glb" and not isinstance(made, trimesh.Trimesh):
        made = trimesh.Scene([made])
    options = {"include_normals": True} if suffix == "glb" and len(surface.faces) else {}
    data = made.export(file_type=suffix, **options)
    with images.atomic_write(path, name=name) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def check_mesh_path(
    path: str | Path, *, baked: bool = False, points: bool = False, name: str = "output"
) -> None:
    """Refuses, before any work, a name that a mesh cannot be written to.

    Args:
        baked: whether it has a texture.
        points: whether it has no faces.

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
    if baked and suffix != ".glb":
        raise ValueError(f"{where} cannot hold a texture; name a .glb, or leave bake out")
    if points and suffix == ".obj":
        raise ValueError(f"{where} cannot hold coloured points; name a .glb or .ply")
    images.check_writable(path, suffixes=WRITTEN, name=name)


def _textured(texture: Tensor, places: Tensor) -> Any:
    from PIL import Image

    h, w = texture.shape[1:]
    buffer = BytesIO()  # as a file, so that it stays a PNG inside
    Image.fromarray(_bytes(texture.permute(1, 2, 0))).save(buffer, "PNG")
    uv = torch.stack([places[:, 1] / w, 1 - places[:, 0] / h], 1).double().numpy()
    visual = needed("trimesh.visual", "mesh")
    material = visual.material.PBRMaterial(
        baseColorTexture=Image.open(buffer), metallicFactor=0.0, roughnessFactor=0.8
    )
    return visual.TextureVisuals(uv=uv, material=material)


def _bytes(values: Tensor) -> Any:
    return (values.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
