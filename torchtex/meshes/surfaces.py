"""Smooth surfaces from formulas, and flat disks to close them."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchtex.meshes.mesh import Mesh


def surface(
    point: Callable[[Tensor, Tensor], Tensor],
    rows: int,
    columns: int,
    *,
    tiles: tuple[float, float] = (1.0, 1.0),
    first: tuple[float, float] = (0.0, 0.0),
) -> Mesh:
    """A smooth surface from a function of two numbers in [0, 1], down and to the right.

    Args:
        point: (n,) and (n,) to (n, 3); differentiable, as the normals are its derivatives'.
        rows, columns: of squares, each two triangles.
        tiles: how many there are, down and to the right.
        first: row and column in tiles where both numbers are 0.

    Example:
        >>> flat = surface(lambda u, v: torch.stack([v, -u, 0 * u], -1), 2, 2)
        >>> flat.normals[0].abs().tolist()
        [0.0, 0.0, 1.0]
    """
    down = torch.linspace(0, 1, rows + 1, dtype=torch.float64)
    right = torch.linspace(0, 1, columns + 1, dtype=torch.float64)
    u, v = (line.flatten() for line in torch.meshgrid(down, right, indexing="ij"))
    step = 1e-4
    away = u.clamp(2 * step, 1 - 2 * step)  # at the poles of a sphere nothing moves to the right
    fall = point((u + step).clamp(max=1), v) - point((u - step).clamp(min=0), v)
    run = point(away, v + step) - point(away, v - step)
    normals = torch.linalg.cross(fall, run)
    normals = normals / normals.norm(dim=1, keepdim=True).clamp(min=1e-30)
    number = torch.arange((rows + 1) * (columns + 1)).view(rows + 1, columns + 1)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = torch.cat(
        [torch.stack([a, c, b], -1).view(-1, 3), torch.stack([b, c, d], -1).view(-1, 3)]
    )
    uv = torch.stack([first[0] + u * tiles[0], first[1] + v * tiles[1]], -1)
    return Mesh(point(u, v).float(), faces, uv.float(), normals.float())


def curve(points: Tensor, share: Tensor) -> Tensor:
    """A smooth curve through points: cubic pieces whose slopes are those of the neighbours."""
    count = len(points) - 1
    at = (share.clamp(0, 1) * count).clamp(max=count - 1e-9)
    first = at.floor().long()
    t = (at - first)[:, None]
    ends = torch.cat([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    a, b, c, d = (ends[first + k] for k in range(4))
    return b + t / 2 * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))


def disk(radius: float, height: float, up: bool, steps: int, tile: float) -> Mesh:
    """A level disk around the upright axis.

    Args:
        up: whether it is seen from above; else from below.
        steps: triangles.
        tile: side of a tile of the texture; the middle of one is in the middle.

    Example:
        >>> disk(1.0, 0.0, True, 8, 2.0).uv.amax(0).tolist()
        [1.0, 1.0]
    """
    around = torch.linspace(0, 2 * math.pi, steps + 1, dtype=torch.float64)[:-1]
    rim = torch.stack([around.sin(), torch.zeros_like(around), around.cos()], 1) * radius
    level = torch.tensor([0.0, height, 0.0], dtype=torch.float64)
    vertices = torch.cat([torch.zeros(1, 3, dtype=torch.float64), rim]) + level
    number = torch.arange(steps)
    next_ = (number + 1) % steps
    order = (number, next_) if up else (next_, number)
    faces = torch.stack([torch.zeros_like(number), 1 + order[0], 1 + order[1]], 1)
    sign = 1.0 if up else -1.0
    uv = torch.stack([0.5 + sign * vertices[:, 2] / tile, 0.5 + vertices[:, 0] / tile], 1)
    normals = torch.tensor([0.0, sign, 0.0]).expand(len(vertices), 3)
    return Mesh(vertices.float(), faces, uv.float(), normals.contiguous())
