"""Where a mesh stands, and where on a texture it lies."""

import math
from dataclasses import replace

import torch

from torchtex.meshes.mesh import Mesh


def centred(mesh: Mesh) -> Mesh:
    """The mesh in a ball of radius 1 around the origin; solid textures stay where they were.

    Example:
        >>> far = Mesh(9 + torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> centred(far).vertices.norm(dim=1).max().item() <= 1.0001
        True
    """
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    moved = mesh.vertices - (low + high) / 2
    moved = moved / moved.norm(dim=1).max().clamp(min=1e-30)
    return replace(
        mesh, vertices=moved, places=mesh.vertices if mesh.places is None else mesh.places
    )


def wrapped(mesh: Mesh) -> Mesh:
    """The mesh with places on a texture, if it has none: as on a sphere around it.

    Triangles that cross the back, where the texture begins, get vertices of their own.

    Example:
        >>> wrapped(Mesh(torch.rand(3, 3), torch.tensor([[0, 1, 2]]))).uv.shape
        torch.Size([3, 2])
    """
    if mesh.uv is not None:
        return mesh
    corners = mesh.vertices[mesh.faces]
    x, y, z = corners.unbind(-1)
    around = torch.atan2(x, z) / (2 * math.pi) + 0.5
    far = around.amax(1, keepdim=True) - around > 0.5
    around = torch.where(far, around + 1, around)
    pole = x.square() + z.square() < 1e-12 * corners.square().sum(-1)
    beside = torch.where(pole, 0, around).sum(1, keepdim=True) / (~pole).sum(1, keepdim=True)
    around = torch.where(pole & ~pole.all(1, keepdim=True), beside, around)
    down = torch.acos((y / corners.norm(dim=-1).clamp(min=1e-12)).clamp(-1, 1)) / math.pi
    return replace(mesh.unshared(), uv=torch.stack([down, 2 * around], -1).view(-1, 2))
