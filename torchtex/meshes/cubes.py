"""Cubes, whole or with a corner taken away."""

import torch

from torchtex.meshes.mesh import Mesh

Point = tuple[float, float, float]


def cube(side: float = 1.15) -> Mesh:
    """A cube, one tile on every face, whose places run from 0 to 1 along its edges.

    Example:
        >>> len(cube().faces), cube().places.amax().item()
        (12, 1.0)
    """
    return _boxes([((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))], side)


def cube_cutaway(cut: float = 0.5, side: float = 1.15) -> Mesh:
    """A cube of which the corner at the right, above and in front is taken away.

    Its places are (x, y, z) from 0 to 1 along its edges, for colours of a volume.

    Args:
        cut: share of each edge that is gone.
        side: of the cube.

    Raises:
        ValueError: a cut that leaves nothing, or is none.

    Example:
        >>> mesh = cube_cutaway()
        >>> bool(((mesh.places > 0.5).all(1)).any())
        False
    """
    if not 0 < cut < 1:
        raise ValueError(f"cut={cut} must lie between 0 and 1")
    k = 1 - cut
    # the faces of three boxes that make the rest, without those that lie between them
    parts = [
        ((0.0, 0.0, 0.0), (1.0, k, 1.0)),
        ((0.0, k, 0.0), (1.0, 1.0, k)),
        ((0.0, k, k), (k, 1.0, 1.0)),
    ]
    return _boxes(parts, side)


def _boxes(parts: list[tuple[Point, Point]], side: float) -> Mesh:
    """Outer faces of boxes inside of the unit cube; what two of them share is left out."""
    corners: list[Point] = []
    uv: list[tuple[float, float]] = []
    faces, normals = [], []
    for number, (low, high) in enumerate(parts):
        for axis in range(3):
            for sign in (-1, 1):
                level = (low, high)[sign > 0][axis]
                for square in _uncovered(parts, number, axis, sign, level):
                    first = len(corners)
                    for p in square:
                        corners.append(p)
                        normals.append([sign * float(k == axis) for k in range(3)])
                        uv.append(_on_face(p, axis, sign))
                    turn = (1, 2, 3) if (sign > 0) == (axis != 1) else (3, 2, 1)
                    faces += [[first, first + turn[0], first + turn[1]]]
                    faces += [[first, first + turn[1], first + turn[2]]]
    places = torch.tensor(corners)
    return Mesh(
        (places - 0.5) * side,
        torch.tensor(faces),
        torch.tensor(uv),
        torch.tensor(normals),
        places=places,
    )


def _on_face(p: Point, axis: int, sign: int) -> tuple[float, float]:
    """Row and column of a place of a face that is seen from outside."""
    x, y, z = p
    if axis == 0:
        return 1 - y, (1 - z if sign > 0 else z)
    if axis == 1:
        return (z if sign > 0 else 1 - z), x
    return 1 - y, (x if sign > 0 else 1 - x)


def _uncovered(
    parts: list[tuple[Point, Point]],
    number: int,
    axis: int,
    sign: int,
    level: float,
) -> list[list[Point]]:
    """Rectangles of a face, cut at all levels that occur, which touch no other box."""
    low, high = parts[number]
    others = [k for k in range(3) if k != axis]
    cuts = []
    for k in others:
        levels = sorted({v[k] for part in parts for v in part} | {low[k], high[k]})
        cuts.append([v for v in levels if low[k] <= v <= high[k]])
    squares = []
    for a0, a1 in zip(cuts[0], cuts[0][1:], strict=False):
        for b0, b1 in zip(cuts[1], cuts[1][1:], strict=False):
            middle = [0.0, 0.0, 0.0]
            middle[axis] = level + sign * 1e-6
            middle[others[0]], middle[others[1]] = (a0 + a1) / 2, (b0 + b1) / 2
            if any(all(u < m < v for u, m, v in zip(*part, middle, strict=True)) for part in parts):
                continue
            square = []
            for a, b in ((a0, b0), (a1, b0), (a1, b1), (a0, b1)):
                point = [level, level, level]
                point[others[0]], point[others[1]] = a, b
                square.append((point[0], point[1], point[2]))
            squares.append(square)
    return squares
