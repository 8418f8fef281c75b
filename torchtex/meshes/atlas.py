"""Meshes laid out flat on a texture."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.meshes.mesh import Mesh

_GAP = 4  # texels of a cell's side that its two triangles leave free


@dataclass(frozen=True, eq=False)
class Atlas:
    """Triangles laid out on a square texture, two in each of its cells.

    Args:
        mesh: with vertices of its own for every triangle, in order, and their `uv`.
        face: which triangle every texel belongs to.
        shares: of the triangle's corners in every texel; beyond its sides some are below 0.
    """

    mesh: Mesh
    face: Int[Tensor, "s s"]
    shares: Float[Tensor, "s s 3"]

    def points(self) -> Float[Tensor, "n 3"]:
        """The place in space of every texel, row by row."""
        corners = self.mesh.vertices.view(-1, 3, 3)[self.face.flatten()]
        return (corners * self.shares.view(-1, 3, 1)).sum(1)


def atlas(mesh: Mesh, size: int) -> Atlas:
    """The layout of a mesh on a texture of size x size texels.

    All triangles are equally large on it, whatever they are in space. Texels around a triangle go
    on in its plane, so that reading between texels finds no other colour.

    Raises:
        ValueError: no triangles, or a texture that is too small for them.

    Example:
        >>> flat = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> atlas(flat, 16).points().shape
        torch.Size([256, 3])
    """
    count = len(mesh.faces)
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
    own = replace(mesh.unshared(), uv=places.view(-1, 2) / size)
    return Atlas(own, face.clamp(max=count - 1), shares)
