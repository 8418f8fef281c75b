"""Smooth things to show textures on: sphere, torus, vase, plane and cloth; see also `solids`.

x points to the right, y up and z to the viewer. A thing lies about the origin, inside of a ball of
radius about 1. Its places on the texture are rows and columns in tiles: rows go down, columns to
the right, seen from outside.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles.

    Args:
        vertices: places in space.
        faces: numbers of the vertices of every triangle.
        uv: of every vertex: row and column on the texture, in tiles.
        normals: of every vertex; None for flat triangles.
        colors: of every vertex, in [0, 1].
        places: of every vertex: where a solid texture is asked for its colour.
        texture: (k, h, w), one that came with the mesh.

    Raises:
        ValueError: arrays that do not fit, or a face with a vertex that there is none of.

    Example:
        >>> Mesh(torch.rand(3, 3), torch.tensor([[0, 1, 2]])).uv is None
        True
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
        if not len(self.faces):
            raise ValueError("faces is empty; a mesh needs at least one triangle")
        if int(self.faces.min()) < 0 or int(self.faces.max()) >= count:
            raise ValueError(f"faces name vertices outside 0..{count - 1}")
        if not bool(self.vertices.isfinite().all()):
            raise ValueError("vertices hold NaN or infinity; repair the mesh")
        for name in ("uv", "normals", "colors", "places"):
            values = getattr(self, name)
            if values is not None and len(values) != count:
                raise ValueError(
                    f"{name} has {len(values)} rows for {count} vertices; give one each"
                )

    def tiled(self, tiles: float) -> "Mesh":
        """The mesh with so many tiles where there was one.

        Example:
            >>> sphere().tiled(3.0).uv.amax(0).tolist()
            [3.0, 6.0]
        """
        return self if self.uv is None else replace(self, uv=self.uv * tiles)


def sphere(rings: int = 48) -> Mesh:
    """A ball; one tile from pole to pole and two around.

    Example:
        >>> sphere(8).vertices.norm(dim=1).sub(1).abs().max() < 1e-6
        tensor(True)
    """

    def point(u: Tensor, v: Tensor) -> Tensor:
        polar, around = math.pi * u, 2 * math.pi * v
        return torch.stack(
            [-polar.sin() * around.cos(), polar.cos(), polar.sin() * around.sin()], -1
        )

    return surface(point, rings, 2 * rings, tiles=(1.0, 2.0))


def torus(rings: int = 48, radius: float = 0.34) -> Mesh:
    """A ring, a little tilted; one tile around the tube and three around the hole.

    Args:
        rings: of triangles around the tube.
        radius: of the tube; the whole ring has radius 1.

    Example:
        >>> torus(8).vertices.norm(dim=1).max() <= 1
        tensor(True)
    """

    def point(u: Tensor, v: Tensor) -> Tensor:
        tube, around = 2 * math.pi * u, 2 * math.pi * v
        away = (1 - radius) - radius * tube.cos()
        return torch.stack([-away * around.cos(), radius * tube.sin(), away * around.sin()], -1)

    return surface(point, rings, 3 * rings, tiles=(1.0, 3.0))


def vase(rings: int = 64) -> Mesh:
    """A vase: a profile turned around the upright axis; one and a half tiles high, three around.

    Example:
        >>> vase(8).vertices[:, 1].amax().item()
        1.0
    """
    profile = torch.tensor(
        [
            (0.33, 1.0), (0.28, 0.93), (0.21, 0.8), (0.22, 0.66), (0.34, 0.48), (0.5, 0.24),
            (0.58, 0.0), (0.56, -0.26), (0.46, -0.55), (0.34, -0.8), (0.3, -0.92), (0.34, -1.0),
        ],
        dtype=torch.float64,
    )  # fmt: skip

    def point(u: Tensor, v: Tensor) -> Tensor:
        radius, height = _curve(profile, u).unbind(-1)
        around = 2 * math.pi * v
        return torch.stack([-radius * around.cos(), height, radius * around.sin()], -1)

    return surface(point, rings, rings, tiles=(1.5, 3.0))


def cloth(steps: int = 72) -> Mesh:
    """A hanging cloth in folds; two tiles each way.

    Example:
        >>> cloth(8).uv.amax(0).tolist()
        [2.0, 2.0]
    """

    def point(u: Tensor, v: Tensor) -> Tensor:
        x, y = 2 * v - 1, 1 - 2 * u
        fold = 0.13 * torch.sin(9 * x + 1.6 * y + 0.4) * (0.35 + 0.65 * u)
        fold = fold + 0.06 * torch.sin(17 * x - 2.5 * y) * u + 0.06 * torch.sin(2 * x - 3 * y)
        sag = -0.05 * u * torch.cos(3 * x)
        return torch.stack([0.95 * x, 0.95 * y + sag, fold], -1)

    return surface(point, steps, steps, tiles=(2.0, 2.0))


def plane(side: float = 40.0) -> Mesh:
    """Level ground around the origin, one tile on every square of side 1.

    Example:
        >>> plane(2.0).uv.amin(0).tolist()
        [-1.0, -1.0]
    """

    def point(u: Tensor, v: Tensor) -> Tensor:
        return torch.stack([(v - 0.5) * side, 0 * u, (u - 0.5) * side], -1)

    return surface(point, 1, 1, tiles=(side, side), first=(-side / 2, -side / 2))


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


def _curve(points: Tensor, share: Tensor) -> Tensor:
    """A smooth curve through points: cubic pieces whose slopes are those of the neighbours."""
    count = len(points) - 1
    at = (share.clamp(0, 1) * count).clamp(max=count - 1e-9)
    first = at.floor().long()
    t = (at - first)[:, None]
    ends = torch.cat([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    a, b, c, d = (ends[first + k] for k in range(4))
    return b + t / 2 * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
