"""Rough marks on a picture: painted, and laid where what is under them goes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.sources import copied

CORE = 0.5
"""From this value on a pixel of a stroke's mask belongs to the object."""
FAINT = 0.05
"""Paint up to this value counts as none, so that an airbrush ends somewhere."""

Points = Sequence[tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Stroke:
    """A rough mark on the reference, and where what is under it goes.

    Args:
        mask: of the reference's size. True, or from 0.5 on, marks the object; lighter paint,
            above 0.05, leaves it to the cut whether a pixel belongs to it.
        offset: rows and columns that the middle of the mark moves by.
        rotation: in degrees, counter-clockwise, about the middle of the mark.
        scale: size of the object in the base; below 0.5 fine detail is skipped, not averaged.
        mirror: exchange left and right, before it is turned.

    Raises:
        ValueError: a mask without paint or with values outside [0, 1], or a scale or rotation
            that is none.

    Example:
        >>> Stroke(brush((32, 32), [(8.0, 8.0), (8.0, 12.0)], 3.0), (10, -4), rotation=90.0).scale
        1.0
    """

    mask: Float[Tensor, "hz wz"] | Bool[Tensor, "hz wz"]
    offset: tuple[int, int]
    rotation: float = 0.0
    scale: float = 1.0
    mirror: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.scale < math.inf:
            raise ValueError(f"scale={self.scale} must be above 0, and finite")
        if not math.isfinite(self.rotation):
            raise ValueError(f"rotation={self.rotation} must be a number of degrees")
        if self.mask.ndim != 2 or not self.mask.numel():
            raise ValueError(f"mask has shape {tuple(self.mask.shape)}; give (rows, columns)")
        if not bool(((self.mask >= 0) & (self.mask <= 1)).all()):
            raise ValueError("mask has values outside 0..1; scale them")
        if not bool((self.mask >= CORE).any()):
            raise ValueError(
                f"mask is empty: no pixel is {CORE} or more; paint over the object in white"
            )


def brush(size: tuple[int, int], path: Points, radius: float) -> Bool[Tensor, "h w"]:
    """What a round brush paints along a path.

    Args:
        size: (height, width) of the mask.
        path: (row, column) of its corners; one is a dot.
        radius: of the brush, in pixels.

    Raises:
        ValueError: no path, no radius, or nothing painted inside the image.

    Example:
        >>> brush((3, 5), [(1.0, 1.0), (1.0, 3.0)], 0.5).int().tolist()
        [[0, 0, 0, 0, 0], [0, 1, 1, 1, 0], [0, 0, 0, 0, 0]]
    """
    if not 0 < radius < math.inf:
        raise ValueError(f"radius={radius} must be above 0, and finite")
    if not len(path):
        raise ValueError("path is empty; give at least one point [row, column]")
    row, col = _grid(size)
    painted = torch.zeros(size, dtype=torch.bool)
    for (r0, c0), (r1, c1) in zip(path, path[1:] if len(path) > 1 else path, strict=False):
        square = (r1 - r0) ** 2 + (c1 - c0) ** 2
        along = (row - r0) * (r1 - r0) + (col - c0) * (c1 - c0)
        share = (along / square).clamp(0, 1) if square > 0 else torch.zeros(size)
        apart = (row - r0 - share * (r1 - r0)) ** 2 + (col - c0 - share * (c1 - c0)) ** 2
        painted |= apart <= radius**2
    return _inside(painted, "path")


def polygon(size: tuple[int, int], points: Points) -> Bool[Tensor, "h w"]:
    """The pixels whose middle lies in a polygon.

    Args:
        size: (height, width) of the mask.
        points: (row, column) of its corners, three or more.

    Raises:
        ValueError: less than three corners, or nothing painted inside the image.

    Example:
        >>> polygon((3, 3), [(-1.0, -1.0), (-1.0, 1.5), (3.0, 1.5), (3.0, -1.0)])[0].tolist()
        [True, True, False]
    """
    if len(points) < 3:
        raise ValueError(f"polygon has {len(points)} points; give at least three")
    row, col = _grid(size)
    inside = torch.zeros(size, dtype=torch.bool)
    for (r0, c0), (r1, c1) in zip(points, [*points[1:], points[0]], strict=True):
        if r0 != r1:  # a crossing of the ray to the right changes sides
            inside ^= ((row < r0) != (row < r1)) & (
                col < c0 + (row - r0) / (r1 - r0) * (c1 - c0)
            )  # fmt: skip
    return _inside(inside, "polygon")


def _grid(size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    row, col = (torch.arange(length, dtype=torch.float64) for length in size)
    return row[:, None], col[None]


def _inside(painted: Tensor, name: str) -> Tensor:
    if not painted.any():
        h, w = painted.shape
        raise ValueError(f"{name} paints no pixel of the {h} x {w} reference; move it inside")
    return painted


@dataclass(frozen=True)
class Placed:
    """The reference and a stroke as they lie in a window of the base.

    Args:
        window: rows and columns of the base.
        positions: (h, w, 3) in the exemplars, of the whole window.
        image: (c, h, w), what the reference shows there.
        marked: (h, w), pixels of the object.
        free: where the reference may go: those, and the uncertain ones.
        around: pixels of the reference beyond, which tell what is around the object.
        beyond: distance from the marked pixels, in radii of a disk of their area.
    """

    window: tuple[slice, slice]
    positions: Tensor
    image: Tensor
    marked: Tensor
    free: Tensor
    around: Tensor
    beyond: Tensor


def place(
    size: Sequence[int],
    source: Tensor,
    usable: Tensor,
    stroke: Stroke,
    band: int | None,
    number: int,
) -> Placed:
    """The reference as a stroke moves it, in a window of the base.

    Args:
        size: (height, width) of the base.
        source: the reference.
        usable: (h, w), 1 where it may be used.
        band: width of the uncertain band in pixels; None for 1.5 times the radius of a disk of
            the mark's area.
        number: of the stroke, for errors.

    Raises:
        ValueError: nothing of the mark lies inside the base.

    Example:
        >>> stroke = Stroke(brush((20, 20), [(8.0, 8.0)], 3.0), (4, 6))
        >>> placed = place((20, 20), torch.rand(3, 20, 20), torch.ones(20, 20), stroke, None, 1)
        >>> int(placed.marked.sum())
        29
    """
    mask = stroke.mask.to(source)
    radius = math.sqrt(float((mask >= CORE).sum()) / math.pi) * stroke.scale
    band = max(4, round(1.5 * radius)) if band is None else band
    ring = max(3, band // 2)
    margin = band + ring + 1
    move = _Move.of(stroke, mask)
    corners = move.forward(_corners(mask))
    low, high = corners.floor().long().amin(0) - margin, corners.ceil().long().amax(0) + margin + 1
    window = tuple(
        slice(min(max(0, int(a)), n), min(max(0, int(b)), n))
        for a, b, n in zip(low, high, size, strict=True)
    )
    rows, cols = (torch.arange(s.start, s.stop, dtype=torch.float64) for s in window)
    places = move.back(torch.stack(torch.meshgrid(rows, cols, indexing="ij"), -1).to(source.device))
    room = torch.tensor(source.shape[1:], device=source.device) - 1
    exists = ((places >= -1e-6) & (places <= room + 1e-6)).all(-1)
    places = torch.minimum(places.clamp_min(0), room.to(places))
    places = places.round().long() if move.whole else places.float()
    positions = F.pad(places, (1, 0))
    inside = bool(exists.any())
    shape = ((source.shape[1], source.shape[2]),)
    image, paint, allowed = source[:, :0], mask[:0], mask[:0]
    if inside:
        field = copied(positions, shape)
        image = field.apply(source)
        paint, allowed = (field.apply(x[None])[0] for x in (mask, usable))
        exists &= allowed >= 1
        paint = torch.where(exists, paint, 0)
    if not inside or not (paint >= CORE).any():
        raise ValueError(
            f"stroke {number}: offset={tuple(stroke.offset)} leaves nothing of the mark inside the "
            f"base of {size[0]} x {size[1]} pixels; choose an offset that does"
        )
    near = distance(paint >= CORE, margin)
    free = ((near <= band) | (paint > FAINT)) & exists
    around = (distance(free, ring) <= ring) & ~free & exists
    return Placed(
        (window[0], window[1]), positions, image, paint >= CORE, free, around, near / radius
    )


@dataclass(frozen=True)
class _Move:
    """Where a point of the reference goes in the base, and back."""

    pivot: Tensor
    offset: Tensor
    turn: Tensor
    scale: float
    whole: bool

    @staticmethod
    def of(stroke: Stroke, mask: Tensor) -> "_Move":
        box = _corners(mask)
        pivot = torch.div(box[0] + box[-1], 2, rounding_mode="floor")  # whole, as are its turns
        quarters = stroke.rotation / 90
        whole = quarters == round(quarters)
        angle = math.radians(stroke.rotation % 360)
        cos, sin = math.cos(angle), math.sin(angle)
        if whole:
            cos, sin = round(cos), round(sin)
        side = -1 if stroke.mirror else 1
        turn = torch.tensor([[cos, -sin * side], [sin, cos * side]], dtype=torch.float64)
        offset = torch.tensor(stroke.offset, dtype=torch.float64)
        whole = whole and stroke.scale == 1 and bool((offset == offset.round()).all())
        return _Move(pivot, offset.to(pivot), turn.to(pivot), stroke.scale, whole)

    def forward(self, points: Tensor) -> Tensor:
        return self.pivot + self.offset + self.scale * (points - self.pivot) @ self.turn.T

    def back(self, points: Tensor) -> Tensor:
        return self.pivot + (points - self.pivot - self.offset) @ self.turn / self.scale


def _corners(mask: Tensor) -> Tensor:
    """(4, 2), of the smallest box around the paint; the first and the last are opposite."""
    rows, cols = ((mask > FAINT).any(dim).nonzero().flatten() for dim in (1, 0))
    ends = [(r, c) for r in (rows[0], rows[-1]) for c in (cols[0], cols[-1])]
    return torch.stack([torch.stack(pair) for pair in ends]).double()


def distance(mask: Tensor, limit: int) -> Tensor:
    """(h, w): exact distance to the nearest True pixel, and limit + 1 beyond the limit.

    Example:
        >>> distance(torch.tensor([[True, False, False]]), 1).tolist()
        [[0.0, 1.0, 2.0]]
    """
    h, w = mask.shape
    far = float(limit + 1)
    col = torch.arange(w, device=mask.device, dtype=torch.float64).expand(h, -1)
    before = torch.where(mask, col, -torch.inf).cummax(1).values
    after = torch.where(mask, col, torch.inf).flip(1).cummin(1).values.flip(1)
    across = torch.minimum(col - before, after - col).square()
    best = across.clone()
    for step in range(1, min(limit, h - 1) + 1):
        best[step:] = torch.minimum(best[step:], across[:-step] + step**2)
        best[:-step] = torch.minimum(best[:-step], across[step:] + step**2)
    return best.sqrt().clamp_max(far)
