"""What a mesh is: triangles, or points alone, and what their surface looks like."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

_WELD = 1e5  # steps along the longest side, within which vertices are one


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, or points alone.

    x points to the right, y up and z to the viewer.

    Args:
        vertices: places in space.
        faces: numbers of the vertices of every triangle; none for points.
        uv: of every vertex: row and column on the texture, in tiles.
        normals: of every vertex; None for flat triangles.
        colors: of every vertex, in [0, 1].
        places: of every vertex: where a solid texture is asked for its colour.
        texture: (k, h, w) in [0, 1], one that came with the mesh.

    Raises:
        ValueError: arrays that do not fit, vertices that are not finite, or a face with a vertex
            that there is none of.

    Example:
        >>> Mesh(torch.eye(3), torch.tensor([[0, 1, 2]])).closed
        False
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "m 3"]
    uv: Float[Tensor, "v 2"] | None = None
    normals: Float[Tensor, "v 3"] | None = None
    colors: Float[Tensor, "v c"] | None = None
    places: Float[Tensor, "v 3"] | None = None
    texture: Float[Tensor, "k h w"] | None = None

    def __post_init__(self) -> None:
        count = len(self.vertices)
        if not count:
            raise ValueError("mesh has no vertices; give one with a surface, or points")
        if not bool(self.vertices.isfinite().all()):
            raise ValueError("mesh has vertices that are NaN or infinite; repair it")
        if len(self.faces) and not 0 <= int(self.faces.min()) <= int(self.faces.max()) < count:
            raise ValueError(f"mesh has faces with vertices outside 0..{count - 1}; repair it")
        for name, values in self.of_vertices().items():
            if len(values) != count:
                raise ValueError(
                    f"{name} has {len(values)} rows for {count} vertices; give one each"
                )

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

    def of_vertices(self) -> dict[str, Tensor]:
        """What there is beside their places in space, by name."""
        named = {
            "uv": self.uv, "normals": self.normals, "colors": self.colors, "places": self.places,
        }  # fmt: skip
        return {name: values for name, values in named.items() if values is not None}

    def tiled(self, tiles: float) -> "Mesh":
        """The mesh with so many tiles where there was one.

        Example:
            >>> flat = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]), uv=torch.ones(3, 2))
            >>> flat.tiled(3.0).uv[0].tolist()
            [3.0, 3.0]
        """
        return self if self.uv is None else replace(self, uv=self.uv * tiles)

    def unshared(self) -> "Mesh":
        """The mesh with vertices of its own for every triangle, in order.

        Example:
            >>> pair = Mesh(torch.rand(4, 3), torch.tensor([[0, 1, 2], [2, 1, 3]]))
            >>> pair.unshared().faces.tolist()
            [[0, 1, 2], [3, 4, 5]]
        """
        index = self.faces.flatten()
        own = {name: values[index] for name, values in self.of_vertices().items()}
        faces = torch.arange(len(index), device=index.device).view(-1, 3)
        return replace(self, vertices=self.vertices[index], faces=faces, **own)


def joined(meshes: "list[Mesh]") -> Mesh:
    """One mesh of several, each with the same kinds of values; textures are left out.

    Raises:
        ValueError: no meshes.

    Example:
        >>> flat = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> joined([flat, flat]).faces.tolist()
        [[0, 1, 2], [3, 4, 5]]
    """
    if not meshes:
        raise ValueError("meshes is empty; give at least one")
    faces, first = [], 0
    for mesh in meshes:
        faces.append(mesh.faces + first)
        first += len(mesh.vertices)
    values = [mesh.of_vertices() for mesh in meshes]
    shared = {name: torch.cat([each[name] for each in values]) for name in values[0]}
    return Mesh(torch.cat([mesh.vertices for mesh in meshes]), torch.cat(faces), **shared)
