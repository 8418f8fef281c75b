"""A canvas made again from a source field: what every piece shows, beyond its seams too.

Neighbours whose sources lie beside each other are of one piece. Beyond a seam a piece goes on as it
did before it, so that the seams of any montage can be measured, and older ones counted in a cut.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from torchtex.cuts.seams import present_seams
from torchtex.sources import copied

_JOINED = (0.3, 1.8)  # least and most pixels between the sources of neighbours of one piece


@dataclass
class MendedCanvas:
    """Views, sources and patches of pixels, the things that must stay, and the cost of seams.

    Args:
        views: of `views_of`.
        positions: exemplar, row and column.
        patches: number of the patch of every pixel.
        held: number of the thing that a pixel belongs to, -1 for none.
        periodic: its opposite borders are neighbours.

    Example:
        >>> z = torch.rand(1, 4, 4)
        >>> places = torch.zeros(2, 2, 3, dtype=torch.long)
        >>> nothing = torch.zeros(2, 2, dtype=torch.long)
        >>> MendedCanvas(views_of(places, [z]), places, nothing, nothing - 1, False).seams.shape
        torch.Size([2, 2])
    """

    views: Float[Tensor, "5 c h w"]
    positions: Tensor
    patches: Int[Tensor, "h w"]
    held: Int[Tensor, "h w"]
    periodic: bool
    seams: Float[Tensor, "h w"] = field(init=False)

    def __post_init__(self) -> None:
        self.seams = torch.zeros_like(self.views[0, 0])
        self.measure(0, 0, self.size)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.patches.shape[0], self.patches.shape[1]

    def index(self, top: int, left: int, side: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Rows and columns of a rectangle, which may go on across the border."""
        device = self.patches.device
        rows = torch.arange(top, top + side[0], device=device) % self.size[0]
        return rows[:, None], torch.arange(left, left + side[1], device=device) % self.size[1]

    def beside(self, top: int, left: int, side: tuple[int, int]) -> Bool[Tensor, "h w"]:
        """Pixels of a rectangle that have a neighbour outside of it."""
        edge = torch.zeros(side, dtype=torch.bool, device=self.patches.device)
        edge[0] |= self.periodic or top > 0
        edge[-1] |= self.periodic or top + side[0] < self.size[0]
        edge[:, 0] |= self.periodic or left > 0
        edge[:, -1] |= self.periodic or left + side[1] < self.size[1]
        return edge

    def measure(self, top: int, left: int, side: tuple[int, int]) -> None:
        """Costs of the seams to the right of and below the pixels of a rectangle."""
        ends = [start + extent + 1 for start, extent in zip((top, left), side, strict=True)]
        if not self.periodic:
            top, left = max(top, 0), max(left, 0)
            ends = [min(end, extent) for end, extent in zip(ends, self.size, strict=True)]
        else:
            ends = [min(e, s + n + 1) for e, s, n in zip(ends, (top, left), self.size, strict=True)]
        rows, cols = self.index(top, left, (ends[0] - top, ends[1] - left))
        across, down = present_seams(self.views[..., rows, cols], gradient=True)
        total = pad(across, (0, 1)) + pad(down, (0, 0, 0, 1))
        # the last lines have neighbours that were not looked at, unless the canvas ends there
        height = len(rows) - (self.periodic or ends[0] < self.size[0])
        width = len(cols) - (self.periodic or ends[1] < self.size[1])
        self.seams[rows[:height], cols[:width]] = total[:height, :width]


def views_of(
    positions: Tensor, zs: Sequence[Float[Tensor, "c _ _"]], *, periodic: bool = False
) -> Float[Tensor, "5 c h w"]:
    """What the piece that owns a pixel shows there and below, right, above and left of it.

    Args:
        positions: (h, w, 3), exemplar, row and column.
        periodic: opposite borders are neighbours.

    Example:
        >>> from torchtex.cuts.seams import patch_views
        >>> from torchtex.sources import pixel_places
        >>> z = torch.rand(1, 4, 4)
        >>> torch.equal(views_of(pad(pixel_places((4, 4)), (1, 0)), [z]), patch_views(z))
        True
    """
    shapes, images = [(z.shape[1], z.shape[2]) for z in zs], list(zs)
    found = positions.double()
    room = found.new_tensor(shapes)[found[..., 0].long()] - 1
    steps = [_steps(found, axis, periodic) for axis in (0, 1)]
    views = [copied(positions, shapes).apply(images)]
    for axis, sign in ((0, 1), (1, 1), (0, -1), (1, -1)):
        joined = steps[axis][1]
        place = found.clone()
        place[..., 1:] += sign * _onward(steps, axis, sign)
        place[..., 1:] = torch.minimum(place[..., 1:].clamp_min(0), room)
        place = place if positions.is_floating_point() else place.round()
        shown = copied(place.to(positions.dtype), shapes).apply(images)
        joined = joined if sign > 0 else joined.roll(1, axis)
        views.append(torch.where(joined, views[0].roll(-sign, axis + 1), shown))
    return torch.stack(views)


def edges_of(numbers: Int[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Pixels with a pixel of another number in the square of nine around them.

    Example:
        >>> edges_of(torch.tensor([[0, 0, 0, 1]])).tolist()
        [[False, False, True, True]]
    """
    wide = pad(numbers[None].double(), (1, 1, 1, 1), mode="replicate")
    return (max_pool2d(wide, 3, 1) != -max_pool2d(-wide, 3, 1))[0]


def _steps(found: Tensor, axis: int, periodic: bool) -> tuple[Tensor, Tensor]:
    """Source of the next pixel less that of each, and whether both are of one piece."""
    ahead = found.roll(-1, axis) - found
    size = ahead[..., 1:].norm(dim=-1)
    joined = (ahead[..., 0] == 0) & (size >= _JOINED[0]) & (size <= _JOINED[1])
    if not periodic:
        joined.select(axis, -1).fill_(False)
    return ahead[..., 1:], joined


def _onward(steps: list[tuple[Tensor, Tensor]], axis: int, sign: int) -> Tensor:
    """The step of a piece beyond a seam: as before it, else as across, else that of a copy."""
    (ahead, joined), (other, known) = steps[axis], steps[1 - axis]
    if sign > 0:
        ahead, joined = ahead.roll(1, axis), joined.roll(1, axis)
    back, there = other.roll(1, 1 - axis), known.roll(1, 1 - axis)
    across = torch.where(known[..., None], other, back)
    turned = torch.stack([-across[..., 1], across[..., 0]], -1) * (1 if axis else -1)
    plain = torch.zeros_like(ahead)
    plain[..., axis] = 1.0
    plain = torch.where((known | there)[..., None], turned, plain)
    return torch.where(joined[..., None], ahead, plain)
