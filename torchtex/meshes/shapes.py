"""Things to show textures on, and to carve out of volumes, by name.

x points to the right, y up and z to the viewer. A thing lies about the origin, inside of a ball of
radius about 1. Its places on the texture are rows and columns in tiles: rows go down, columns to
the right, seen from outside.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchtex.meshes.cubes import cube
from torchtex.meshes.mesh import Mesh, joined
from torchtex.meshes.surfaces import curve, disk, surface


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
        radius, height = curve(profile, u).unbind(-1)
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


def cylinder(steps: int = 96) -> Mesh:
    """An upright cylinder; one tile high and two around, and one across its ends.

    Example:
        >>> cylinder(8).closed
        True
    """
    radius, half = 0.56, 0.83

    def point(u: Tensor, v: Tensor) -> Tensor:
        around = 2 * math.pi * v
        height = half - 2 * half * u
        return torch.stack([-radius * around.cos(), height, radius * around.sin()], -1)

    side = surface(point, 1, steps, tiles=(1.0, 2.0))
    ends = [disk(radius, sign * half, sign > 0, steps, 2 * half) for sign in (1, -1)]
    return joined([side, *ends])


def cone(steps: int = 96) -> Mesh:
    """An upright cone; the texture is not stretched, as if it were rolled up from a flat sheet.

    Example:
        >>> cone(8).closed
        True
    """
    radius, top, base, tile = 0.8, 1.0, -0.6, 1.6
    slant = math.hypot(radius, top - base)

    def point(u: Tensor, v: Tensor) -> Tensor:
        around = 2 * math.pi * v
        out = -radius * u
        return torch.stack([out * around.sin(), top - (top - base) * u, out * around.cos()], -1)

    side = surface(point, 24, steps)
    assert side.uv is not None
    u, v = side.uv.unbind(1)
    turn = 2 * math.pi * radius / slant * (v - 0.5)
    flat = torch.stack([u * turn.cos(), u * turn.sin()], 1) * slant / tile
    return joined([replace(side, uv=flat), disk(radius, base, False, steps, tile)])


def bowl(rings: int = 96) -> Mesh:
    """A bowl with a thick wall; three tiles around, and about as large ones along its profile.

    Example:
        >>> bowl(8).closed
        True
    """
    profile = torch.tensor(
        [
            (0.0, -0.3), (0.25, -0.28), (0.48, -0.18), (0.67, 0.02), (0.79, 0.27), (0.86, 0.45),
            (0.9, 0.475), (0.93, 0.44), (0.88, 0.2), (0.76, -0.08), (0.58, -0.3), (0.4, -0.42),
            (0.35, -0.49), (0.33, -0.55), (0.0, -0.53),
        ],
        dtype=torch.float64,
    )  # fmt: skip

    def point(u: Tensor, v: Tensor) -> Tensor:
        radius, height = curve(profile, u).unbind(-1)
        around = 2 * math.pi * v
        return torch.stack([-radius * around.cos(), height, radius * around.sin()], -1)

    return surface(point, rings, rings, tiles=(2.0, 4.0))


def knot(steps: int = 320, radius: float = 0.15) -> Mesh:
    """A trefoil knot of a tube; one tile around it, and ten along.

    Args:
        steps: along the tube.
        radius: of the tube; the whole knot has radius 1.

    Example:
        >>> knot(48).closed
        True
    """
    inner = 0.23
    ring = 1 - inner - radius

    def point(u: Tensor, v: Tensor) -> Tensor:
        around, winding = 4 * math.pi * v, 6 * math.pi * v
        away = ring + inner * winding.cos()
        axes = torch.stack([around.cos(), around.sin(), 0 * v], -1)
        beside = torch.stack([-around.sin(), around.cos(), 0 * v], -1)
        front = torch.tensor([0.0, 0.0, 1.0], dtype=v.dtype)
        middle = away[:, None] * axes + inner * winding.sin()[:, None] * front
        # the knot lies on a ring, whose normal is square to it; along it the tube has no twist
        out = winding.cos()[:, None] * axes + winding.sin()[:, None] * front
        along = 2 * away[:, None] * beside - 3 * inner * (
            winding.sin()[:, None] * axes - winding.cos()[:, None] * front
        )
        along = along / along.norm(dim=1, keepdim=True)
        side = torch.linalg.cross(along, out)
        tube = 2 * math.pi * u[:, None]
        return middle + radius * (tube.cos() * out + tube.sin() * side)

    return surface(point, 28, steps, tiles=(1.0, 10.0))


SHAPES: dict[str, Callable[[], Mesh]] = {
    "sphere": sphere, "torus": torus, "vase": vase, "cube": cube, "cylinder": cylinder,
    "cone": cone, "bowl": bowl, "knot": knot, "plane": plane, "cloth": cloth,
}  # fmt: skip
"""Things by name."""


def shape(name: str, argument: str = "mesh") -> Mesh:
    """One of `SHAPES`.

    Args:
        argument: what an error calls the name.

    Raises:
        ValueError: there is none of that name.

    Example:
        >>> shape("dodo")
        Traceback (most recent call last):
        ValueError: mesh='dodo' is unknown; choose sphere, torus, vase, cube, cylinder, cone, ...
    """
    if name not in SHAPES:
        raise ValueError(
            f"{argument}={name!r} is unknown; choose {', '.join(SHAPES)}, or give a mesh"
        )
    return SHAPES[name]()
