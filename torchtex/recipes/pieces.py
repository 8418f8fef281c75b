"""Frames made of rigid pieces of exemplars: what a piece is, and what it shows.

A piece shows a part of an exemplar, unturned and unscaled, at a place that need not be a whole
pixel. It is read from shifted copies of the exemplar, made once by a long filter: so no frame is
blurred by the motion before it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.patches import SsdSearch, ssd_search
from torchtex.sources import SourceField, pixel_places

OLD = 1000
"""Age of a pixel that is not being faded in; ages stop there."""

AROUND = ((0, 0), (1, 0), (0, 1), (-1, 0), (0, -1))
"""A pixel, and those below, right, above and left of it, as in `cuts.seams.patch_views`."""

_TAPS = 6  # of the filter that reads between pixels
_LARGEST = 2**26  # numbers that the shifted exemplars may take


@dataclass(frozen=True)
class Pieces:
    """Which piece of which exemplar every pixel of a frame shows.

    Args:
        owner: (h, w), the piece of each pixel; -1 for none.
        before: (h, w), the piece that it is faded from.
        age: (h, w), frames since it changed.
        which: (k,), the exemplar of each piece.
        source: (k, 2), row and column of a pixel of it,
        place: (k, 2), and where in the frame that pixel is.
    """

    owner: Int[Tensor, "h w"]
    before: Int[Tensor, "h w"]
    age: Int[Tensor, "h w"]
    which: Int[Tensor, "k"]
    source: Float[Tensor, "k 2"]
    place: Float[Tensor, "k 2"]


@dataclass(frozen=True)
class Stock:
    """Exemplars made ready to be shown between pixels and to be searched; built by `stock_of`.

    Args:
        size: of a frame.
        periodic: frames are tiles.
        side: of a new piece, in pixels.
        ring: pixels around it that have to fit.
        shifted: of each exemplar (steps^2, c, hz, wz), moved by shares of a pixel.
        usable: where each of them may be read, between pixels too.
        searches: for parts of exemplars; None where no new piece fits one.
        steps: in which a pixel is divided.
    """

    size: tuple[int, int]
    periodic: bool
    side: int
    ring: int
    shifted: tuple[Tensor, ...]
    usable: tuple[Tensor, ...]
    searches: tuple[SsdSearch | None, ...]
    steps: int

    @property
    def reach(self) -> float:
        """How far from its middle a piece may show."""
        return 0.75 * self.side

    def wrapped(self, gap: Tensor) -> Tensor:
        """Differences of places, the short way around where frames are tiles."""
        if not self.periodic:
            return gap
        extent = torch.tensor(self.size, device=gap.device, dtype=gap.dtype)
        return (gap + extent / 2).remainder(extent) - extent / 2

    def units(
        self, pieces: Pieces, owner: Int[Tensor, "*n"], at: Int[Tensor, "*n 2"]
    ) -> Int[Tensor, "*n 2"]:
        """Where pixels of pieces come from, in whole steps from the corner of the exemplar."""
        gap = self.wrapped(at - pieces.place[owner])
        return ((pieces.source[owner] + gap) * self.steps + 0.5).floor().long()

    def free(self, which: Int[Tensor, "*n"], units: Int[Tensor, "*n 2"]) -> Bool[Tensor, "*n"]:
        """Whether those are inside of the exemplar, and may be used."""
        found = torch.zeros_like(which, dtype=torch.bool)
        for number, usable in enumerate(self.usable):
            limit = (torch.tensor(usable.shape, device=units.device) - 1) * self.steps
            inside = ((units >= 0) & (units <= limit)).all(-1) & (which == number)
            near = torch.minimum(units.clamp(min=0), limit) // self.steps
            found |= inside & usable[near[..., 0], near[..., 1]]
        return found

    def views(self, which: Int[Tensor, "*n"], units: Int[Tensor, "*n 2"]) -> Tensor:
        """(5, c, *n): the pixels there and around, see `cuts.seams.patch_views`."""
        steps = [self.steps * torch.tensor(step, device=units.device) for step in AROUND]
        return torch.stack([self.read(which, units + step) for step in steps])

    def read(self, which: Int[Tensor, "*n"], units: Int[Tensor, "*n 2"]) -> Float[Tensor, "c *n"]:
        """The pixels there; beyond the border of an exemplar its edge goes on."""
        found: Tensor | None = None
        for number, shifted in enumerate(self.shifted):
            _, c, h, w = shifted.shape
            limit = torch.tensor([h - 1, w - 1], device=units.device) * self.steps
            inside = torch.minimum(units.clamp(min=0), limit)
            cell, part = inside // self.steps, inside % self.steps
            phase = part[..., 0] * self.steps + part[..., 1]
            flat = shifted.transpose(0, 1).reshape(c, -1)
            value = flat[:, (phase * h + cell[..., 0]) * w + cell[..., 1]]
            found = value if found is None else torch.where(which == number, value, found)
        assert found is not None
        return found


def stock_of(
    exemplars: Sequence[Float[Tensor, "c _ _"]],
    masks: Sequence[Bool[Tensor, "_ _"] | None] | None,
    size: tuple[int, int],
    *,
    periodic: bool = False,
    side: int = 32,
    steps: int = 4,
) -> Stock:
    """Exemplars made ready for frames of a size.

    New pieces are of that side, or smaller where exemplars, masks or frames are small. Pieces
    move in steps of one over `steps` pixels; in whole ones where exemplars are very large.

    Example:
        >>> stock_of([torch.rand(1, 64, 64)], None, (64, 64)).side
        32
    """
    keep = [None] * len(exemplars) if masks is None else list(masks)
    usable = [
        torch.ones(z.shape[1:], dtype=torch.bool, device=z.device) if m is None else m
        for z, m in zip(exemplars, keep, strict=True)
    ]
    if sum(z.numel() for z in exemplars) * steps**2 > _LARGEST:
        steps = 1
    shifted = tuple(_shifted(z, m, steps) for z, m in zip(exemplars, usable, strict=True))
    if steps > 1:  # what is read between pixels must not reach over the border of a mask
        inner = [m if bool(m.all()) else _eroded(m, _TAPS // 2) for m in usable]
        usable = [a if bool(a.any()) else m for a, m in zip(inner, usable, strict=True)]
    least = min(*size, max(min(z.shape[1:]) for z in exemplars))
    side = max(1, min(side, least // 2))
    while True:
        ring = max(1, side // 3)
        fits = [_room(m, side + 2 * ring) for m in usable]
        if any(fits) or side < 4:
            break
        side = side * 3 // 4
    searches = tuple(
        ssd_search(z, None if bool(m.all()) else m) if fit else None
        for z, m, fit in zip(exemplars, usable, fits, strict=True)
    )
    return Stock(size, periodic, side, ring, shifted, tuple(usable), searches, steps)


def _room(usable: Tensor, box: int) -> bool:
    if min(usable.shape) < box:
        return False
    return float(F.avg_pool2d(usable[None, None].float(), box, 1).max()) > 1 - 0.5 / box**2


def _eroded(mask: Tensor, by: int) -> Tensor:
    barred = (~mask)[None, None].float()
    return F.max_pool2d(barred, 2 * by + 1, 1, by)[0, 0] == 0


def _shifted(z: Tensor, usable: Tensor, steps: int) -> Tensor:
    """The exemplar read at shares of a pixel below and to the right of every pixel."""
    z = torch.where(usable, z, 0)
    rows = torch.stack([_between(z, k / steps, 1) for k in range(steps)])
    return torch.cat([torch.stack([_between(r, k / steps, 2) for k in range(steps)]) for r in rows])


def _between(z: Tensor, share: float, axis: int) -> Tensor:
    """Reads along an axis by a windowed sinc, which keeps more detail than cubics do."""
    if share == 0:
        return z
    half = _TAPS // 2
    gaps = [k - half + 1 - share for k in range(_TAPS)]
    taps = [
        math.sin(math.pi * g) * math.sin(math.pi * g / half) / (math.pi**2 * g**2 / half)
        for g in gaps
    ]
    index = torch.arange(z.shape[axis], device=z.device)
    total = torch.zeros_like(z)
    for k, tap in enumerate(taps):
        there = (index + k - half + 1).clamp(0, z.shape[axis] - 1)
        total = total + tap / sum(taps) * z.index_select(axis, there)
    return total.clamp(0, 1)


def pieces_of(offsets: Int[Tensor, "h w 3"], side: int, generator: torch.Generator) -> Pieces:
    """Pieces of a texture whose pixels have sources: equal offsets, cut into cells.

    Args:
        offsets: exemplar, row and column of the source of each pixel.
        side: of a cell, in pixels.

    Example:
        >>> places = torch.zeros(8, 8, 3, dtype=torch.long)
        >>> places[..., 1:] = pixel_places((8, 8)) + 2
        >>> pieces_of(places, 32, torch.Generator()).source.tolist()
        [[6.0, 6.0]]
    """
    h, w = offsets.shape[:2]
    here = pixel_places((h, w), offsets.device)
    seeds = _seeds((h, w), side, generator).to(offsets.device)
    apart = "donot_use_mm_for_euclid_dist"  # a product of matrices depends on the threads
    cell = torch.cdist(here.view(-1, 2).double(), seeds, compute_mode=apart).argmin(1).view(h, w)
    key = torch.cat([offsets[..., :1], offsets[..., 1:] - here, cell[..., None]], -1)
    kinds, owner = key.view(-1, 4).unique(dim=0, return_inverse=True)
    place = means(here.view(-1, 2).double(), owner, len(kinds)).round()
    owner = owner.view(h, w)
    old = torch.full_like(owner, OLD)
    return Pieces(owner, owner.clone(), old, kinds[:, 0], place + kinds[:, 1:3], place)


def _seeds(size: tuple[int, int], side: int, generator: torch.Generator) -> Tensor:
    """A point in every cell of a grid, off its middle."""
    counts = [max(1, round(extent / side)) for extent in size]
    grid = pixel_places(counts).view(-1, 2).double() + 0.5
    off = 0.5 * torch.rand(len(grid), 2, generator=generator, dtype=torch.float64) - 0.25
    return (grid + off) * (torch.tensor(size) / torch.tensor(counts))


def means(
    values: Float[Tensor, "n 2"], group: Int[Tensor, "n"], count: int
) -> Float[Tensor, "k 2"]:
    """Means of pairs by group; 0 for a group without members.

    Example:
        >>> means(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor([1, 1]), 2).tolist()
        [[0.0, 0.0], [2.0, 3.0]]
    """
    number = torch.bincount(group, minlength=count).clamp(min=1)
    sums = [torch.bincount(group, v, minlength=count) for v in values.unbind(1)]
    return torch.stack(sums, 1) / number[:, None]


def rendered(pieces: Pieces, stock: Stock, fade: int) -> tuple[Float[Tensor, "c h w"], SourceField]:
    """The pixels of a frame, and where they come from.

    Args:
        fade: over so many frames a pixel passes into the piece that it has changed to.

    Example:
        >>> z = torch.rand(1, 64, 64)
        >>> places = torch.zeros(64, 64, 3, dtype=torch.long)
        >>> places[..., 1:] = pixel_places((64, 64))
        >>> pieces = pieces_of(places, 32, torch.Generator())
        >>> torch.equal(rendered(pieces, stock_of([z], None, (64, 64)), 3)[0], z)
        True
    """
    here = pixel_places(stock.size, pieces.owner.device)
    shapes = tuple((u.shape[0], u.shape[1]) for u in stock.usable)
    share = ((pieces.age + 1).double() / (fade + 1)).clamp(0, 1)
    layers, places = [], []
    for owner in (pieces.owner, pieces.before):
        units, which = stock.units(pieces, owner, here), pieces.which[owner]
        layers.append(stock.read(which, units))
        limit = (torch.tensor(shapes, device=units.device)[which] - 1) * stock.steps
        spot = torch.minimum(units.clamp(min=0), limit) / stock.steps
        places.append(torch.cat([which[..., None].double(), spot.double()], -1))
    texture = torch.lerp(layers[1], layers[0], share.to(layers[0]))
    texture = torch.where(share == 1, layers[0], texture).clamp(0, 1)
    field = SourceField(torch.stack(places), torch.stack([share, 1 - share]), shapes)
    return texture, field
