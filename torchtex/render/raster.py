"""Triangles to pixels: a z-buffer, attributes in perspective, and textures read without shimmer.

A vertex is given as it is seen, (x, y, w) with the pixel at (x / w, y / w) and w its depth. For a
triangle with these rows in M, the barycentric coordinates divided by w are linear in the pixel:
inverse(M) transposed times (column, row, 1). Inside all three are positive; their sum is 1 / w. So
nothing has to be clipped, also where a triangle passes the camera.

Source: Olano and Greer 1997, Triangle scan conversion using 2D homogeneous coordinates; Williams
1983 for the pyramid of textures.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

_PAIRS = 2**21  # of a triangle and a pixel, looked at together
_NEAR = 1e-3
_THIN = 1e-10


@dataclass(frozen=True)
class Hits:
    """What is seen in the pixels of some rows.

    Args:
        triangle: its number, -1 for none.
        planes: (m, 3, 3), of every triangle: barycentrics / w from (column, row, 1).
        top: the first row.
        depth: 1 / w of what is seen, 0 for nothing.
    """

    triangle: Int[Tensor, "h w"]
    planes: Float[Tensor, "m 3 3"]
    top: int
    depth: Float[Tensor, "h w"]

    def pixels(self) -> Int[Tensor, "n 2"]:
        """Row, from the top, and column of every pixel that shows a triangle."""
        return (self.triangle >= 0).nonzero()

    def weights(
        self, pixels: Int[Tensor, "n 2"], down: float = 0.0, right: float = 0.0
    ) -> Float[Tensor, "n 3"]:
        """Barycentric coordinates, in space, of where pixels see the triangle that they show.

        Args:
            pixels: such as those of `pixels`.
            down, right: of the triangle's plane beside the pixel instead.

        Example:
            >>> corners = torch.tensor([[0.0, 0.0, 1.0], [8.0, 0.0, 1.0], [0.0, 8.0, 1.0]])
            >>> hits = rasterize(corners, torch.tensor([[0, 1, 2]]), (4, 4))
            >>> hits.weights(hits.pixels())[0].tolist()
            [1.0, 0.0, 0.0]
        """
        face = self.triangle[pixels[:, 0], pixels[:, 1]]
        row, column = pixels[:, 0] + (self.top + down), pixels[:, 1] + right
        shares = []
        for corner in range(3):
            a, b, c = self.planes[:, corner].unbind(1)
            shares.append(a[face] * column + b[face] * row + c[face])
        total = shares[0] + shares[1] + shares[2]
        return torch.stack([share / total for share in shares], -1)


def rasterize(
    seen: Float[Tensor, "v 3"],
    faces: Int[Tensor, "m 3"],
    size: tuple[int, int],
    *,
    rows: tuple[int, int] | None = None,
) -> Hits:
    """The nearest triangle in the middle of every pixel.

    Args:
        seen: x, y and w of every vertex.
        faces: numbers of the vertices of every triangle; both sides are seen.
        size: height and width of the picture.
        rows: first and last but one row that are wanted; all unless given.

    Example:
        >>> corners = torch.tensor([[-1.0, -1.0, 1.0], [9.0, -1.0, 1.0], [-1.0, 9.0, 1.0]])
        >>> rasterize(corners, torch.tensor([[0, 1, 2]]), (4, 4)).triangle.unique().tolist()
        [0]
    """
    top, bottom = (0, size[0]) if rows is None else rows
    planes = _planes(seen.double(), faces)
    boxes = _boxes(seen.double(), faces, (top, bottom), size[1])
    height, width = bottom - top, size[1]
    nearest = torch.full((height * width,), 1e-30, dtype=torch.float64, device=seen.device)
    found = torch.full((height * width,), -1, dtype=torch.long, device=seen.device)
    areas = (boxes[:, 1] - boxes[:, 0]).clamp(min=0) * (boxes[:, 3] - boxes[:, 2]).clamp(min=0)
    areas = torch.where(planes.abs().amax((1, 2)) > 0, areas, 0)
    ends = areas.cumsum(0)
    begin = 0
    while begin < len(faces):
        before = int(ends[begin - 1]) if begin else 0
        stop = int(torch.searchsorted(ends, before + _PAIRS, right=True))
        stop = max(stop, begin + 1)
        chosen = torch.arange(begin, stop, device=seen.device)
        _draw(chosen, areas[begin:stop], boxes, planes, (top, width), nearest, found)
        begin = stop
    depth = torch.where(found >= 0, nearest, 0).view(height, width)
    return Hits(found.view(height, width), planes, top, depth)


def _draw(
    chosen: Tensor,
    areas: Tensor,
    boxes: Tensor,
    planes: Tensor,
    frame: tuple[int, int],
    nearest: Tensor,
    found: Tensor,
) -> None:
    """Some triangles, into the z-buffer of 1 / w; the first of equally near ones wins."""
    top, width = frame
    which = torch.repeat_interleave(chosen, areas)
    if not len(which):
        return
    starts = (areas.cumsum(0) - areas).repeat_interleave(areas)
    number = torch.arange(len(which), device=which.device) - starts
    box = boxes[which]
    across = box[:, 3] - box[:, 2]
    row = box[:, 0] + torch.div(number, across, rounding_mode="floor")
    column = box[:, 2] + number % across
    depth = torch.zeros_like(row, dtype=torch.float64)
    for corner in range(3):  # most are outside of the first side already
        a, b, c = planes[:, corner].unbind(1)
        share = a[which] * column + b[which] * row + c[which]
        inside = (share >= 0).nonzero()[:, 0]
        depth = (depth + share)[inside]
        which, row, column = which[inside], row[inside], column[inside]
    near = (depth < 1 / _NEAR).nonzero()[:, 0]
    pixel, depth, which = ((row - top) * width + column)[near], depth[near], which[near]
    before = nearest.clone()
    nearest.scatter_reduce_(0, pixel, depth, "amax")
    best = (depth == nearest[pixel]) & (depth > before[pixel])
    found[pixel[best]] = len(planes)
    found.scatter_reduce_(0, pixel[best], which[best], "amin")


def _planes(seen: Tensor, faces: Tensor) -> Tensor:
    """(m, 3, 3); zeros for triangles that are seen from their edge."""
    corners = seen[faces]
    a, b, c = corners.unbind(1)
    rows = torch.stack([torch.linalg.cross(p, q) for p, q in ((b, c), (c, a), (a, b))], 1)
    volume = (a * rows[:, 0]).sum(1)
    scale = corners.abs().amax((1, 2)).clamp(min=1) ** 2
    flat = volume.abs() < _THIN * scale
    return torch.where(flat[:, None, None], 0, rows / torch.where(flat, 1, volume)[:, None, None])


def _boxes(seen: Tensor, faces: Tensor, rows: tuple[int, int], width: int) -> Tensor:
    """First and last but one row and column that each triangle may show in."""
    corners = seen[faces]
    depth = corners[..., 2]
    whole = (depth > _NEAR).all(1)
    away = (depth <= _NEAR).all(1)
    at = corners[..., :2] / depth.clamp(min=_NEAR)[..., None]
    low, high = at.amin(1).ceil(), at.amax(1).floor() + 1
    box = []
    for axis, (first, last) in ((1, rows), (0, (0, width))):
        start = torch.where(whole, low[:, axis], first).clamp(first, last)
        stop = torch.where(whole, high[:, axis], last).clamp(first, last)
        box += [start, torch.where(away, start, stop)]
    return torch.stack(box, 1).long()


@dataclass(frozen=True)
class Mipmaps:
    """A texture at ever smaller scales; made by `mipmaps`.

    Args:
        levels: (c, h, w) each, the first one the texture.
    """

    levels: tuple[Tensor, ...]

    def __call__(
        self,
        at: Float[Tensor, "n 2"],
        down: Float[Tensor, "n 2"] | None = None,
        right: Float[Tensor, "n 2"] | None = None,
        *,
        readings: int = 8,
    ) -> Float[Tensor, "n c"]:
        """The texture at (row, column) places in tiles, which repeats without end.

        Args:
            down, right: how the place changes from a pixel to the next; without them the
                texture is read between its pixels as it is.
            readings: most of them along the longer side of a pixel's footprint.

        Example:
            >>> mipmaps(torch.tensor([[[0.0, 1.0]]]))(torch.tensor([[0.5, 0.5]])).tolist()
            [[0.5]]
        """
        size = at.new_tensor(self.levels[0].shape[1:])
        if down is None or right is None:
            return _bilinear(self.levels[0], at)
        lengths = torch.stack([(step * size).norm(dim=1) for step in (down, right)], 1)
        long, short = lengths.amax(1), lengths.amin(1)
        way = torch.where((lengths[:, :1] >= lengths[:, 1:]), down, right)
        count = (long / short.clamp(min=1) - 0.25).ceil().clamp(1, readings)
        level = (long / count).clamp(min=1).log2().clamp(max=len(self.levels) - 1)
        total = at.new_zeros(len(at), len(self.levels[0]))
        for step in range(int(count.max()) if len(count) else 0):
            more = (count > step).nonzero()[:, 0]
            share = (step + 0.5) / count[more] - 0.5
            total[more] += self._trilinear(at[more] + share[:, None] * way[more], level[more])
        return total / count[:, None]

    def _trilinear(self, at: Tensor, level: Tensor) -> Tensor:
        low = level.floor().long()
        part = (level - low)[:, None]
        result = at.new_zeros(len(at), len(self.levels[0]))
        for number, texture in enumerate(self.levels):
            for weight, own in ((1 - part, low), (part, low + 1)):
                here = ((own == number) & (weight[:, 0] > 0)).nonzero()[:, 0]
                if len(here):
                    result[here] += weight[here] * _bilinear(texture, at[here])
        return result


def mipmaps(texture: Float[Tensor, "c h w"]) -> Mipmaps:
    """A texture and what it is at a half, a quarter ... of its size, down to one pixel.

    Example:
        >>> [tuple(level.shape) for level in mipmaps(torch.rand(3, 8, 5)).levels]
        [(3, 8, 5), (3, 4, 3), (3, 2, 2), (3, 1, 1)]
    """
    levels = [texture]
    while max(levels[-1].shape[1:]) > 1:
        h, w = levels[-1].shape[1:]
        size = ((h + 1) // 2, (w + 1) // 2)
        levels.append(F.adaptive_avg_pool2d(levels[-1][None], size)[0])
    return Mipmaps(tuple(levels))


def _bilinear(texture: Tensor, at: Tensor) -> Tensor:
    """(n, c): a tile read between its pixels."""
    _, h, w = texture.shape
    place = at * at.new_tensor([h, w]) - 0.5
    corner = place.floor()
    part = (place - corner).to(texture)
    row, column = corner.long().unbind(1)
    flat = texture.flatten(1).T
    total = None
    for i, down in ((0, 1 - part[:, 0]), (1, part[:, 0])):
        for j, right in ((0, 1 - part[:, 1]), (1, part[:, 1])):
            index = (row + i).remainder(h) * w + (column + j).remainder(w)
            term = (down * right)[:, None] * flat[index]
            total = term if total is None else total + term
    assert total is not None
    return total.to(at)
