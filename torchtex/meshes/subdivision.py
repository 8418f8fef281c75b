"""Meshes in smaller triangles, for colours at their corners."""

from dataclasses import replace

import torch
from torch import Tensor

from torchtex.meshes.mesh import Mesh


def subdivide(mesh: Mesh, longest: float, *, most: int = 4_000_000) -> Mesh:
    """The same surface in triangles whose edges are at most so long.

    Edges that are too long are halved, for both of their triangles alike, so no cracks open. What
    vertices have is halfway there too.

    Args:
        longest: edge, in the units of the vertices.
        most: triangles that may be made.

    Raises:
        ValueError: more triangles would be needed.

    Example:
        >>> flat = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> len(subdivide(flat, 1.0).faces)
        4
    """
    values = {"vertices": mesh.vertices, **mesh.of_vertices()}
    faces = mesh.faces
    while True:
        count = len(values["vertices"])
        first, second = faces.flatten(), faces.roll(-1, 1).flatten()
        low, high = torch.minimum(first, second), torch.maximum(first, second)
        key, place = torch.unique(low * count + high, return_inverse=True)
        ends = torch.stack([key // count, key % count], 1)
        length = (values["vertices"][ends[:, 0]] - values["vertices"][ends[:, 1]]).norm(dim=1)
        long = length > longest * (1 + 1e-6)
        if not bool(long.any()):
            break
        added = int(long.sum())
        if len(faces) + 2 * added > most:
            raise ValueError(
                f"detail: more than {most} triangles would be needed for this mesh; "
                "choose a larger detail or a smaller scale, or bake a texture"
            )
        number = torch.full((len(key),), -1)
        number[long] = count + torch.arange(added)
        values = {
            name: torch.cat([given, given[ends[long]].mean(1)]) for name, given in values.items()
        }
        faces = _split(faces, number[place].view(-1, 3))
    if "normals" in values:
        values["normals"] = torch.nn.functional.normalize(values["normals"], dim=1)
    return replace(mesh, faces=faces, **values)


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
