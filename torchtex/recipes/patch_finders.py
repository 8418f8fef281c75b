"""Where in the sources a patch fits what is known of it: at all places, or at a few, found quickly.

The zone that is known differs from patch to patch, so nothing is made ready for one zone alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.layouts import places_of
from torchtex.patches import SsdSearch, ssd_exhaustive, ssd_search, summed_area
from torchtex.qtp import Qtp, QtpIndex

Search = Literal["exhaustive", "fft", "qtp"] | Qtp


@runtime_checkable
class Finder(Protocol):
    """Costs of places for a template, and their numbers.

    `dearer` is what the cost of every place will be multiplied by. Costs are told without it, but a
    search that looks at a few places chooses them by it.
    """

    def __call__(
        self,
        template: Float[Tensor, "c s s"],
        zone: Bool[Tensor, "s s"],
        dearer: Float[Tensor, "m"],
    ) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]: ...

    def places(self) -> Int[Tensor, "m 3"]:
        """Source, row and column of all."""
        ...


def finder_of(
    search: Search, zs: Sequence[Tensor], masks: Sequence[Tensor | None], side: int
) -> Finder:
    """A search in several sources for patches of one side.

    Raises:
        ValueError: an unknown search, or a side that fits nowhere in the masks.

    Example:
        >>> z = torch.rand(3, 30, 30)
        >>> zone = torch.ones(16, 16, dtype=torch.bool)
        >>> zone[6:, 6:] = False
        >>> finder = finder_of("qtp", [z], [None], 16)
        >>> places = finder.places()
        >>> costs, found = finder(z[:, 9:25, 5:21], zone, torch.ones(len(places)))
        >>> costs.min().item(), places[found[costs.argmin()]].tolist()
        (0.0, [0, 9, 5])
    """
    allowed = places_of(zs, masks, side, "patch").positions
    if search == "exhaustive":
        return Everywhere(allowed, tuple(zs))
    fft = Everywhere(allowed, tuple(ssd_search(z) for z in zs))
    if search == "fft":
        return fft
    if search != "qtp" and not isinstance(search, Qtp):
        raise ValueError(f"search={search!r} is unknown; choose exhaustive, fft or qtp")
    qtp = Qtp((256, 64, 16), axes=None) if search == "qtp" else search
    counts = torch.bincount(allowed[:, 0], minlength=len(zs)).tolist()
    starts = [sum(counts[:n]) for n in range(len(zs))]
    return Quick(fft, [_pyramid(qtp, zs[n], masks[n], starts[n], side)
                       for n in range(len(zs)) if counts[n]])  # fmt: skip


@dataclass(frozen=True)
class Everywhere:
    """Costs of all places.

    Args:
        allowed: the places.
        exemplars: the sources, made ready for transforms or as they are.
    """

    allowed: Int[Tensor, "n 3"]
    exemplars: Sequence[SsdSearch | Tensor]

    def places(self) -> Int[Tensor, "n 3"]:
        """All of them."""
        return self.allowed

    def __call__(
        self,
        template: Float[Tensor, "c s s"],
        zone: Bool[Tensor, "s s"],
        dearer: Float[Tensor, "m"],
    ) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
        found = []
        for number, z in enumerate(self.exemplars):
            own = self.allowed[self.allowed[:, 0] == number]
            if not len(own):
                continue
            if isinstance(z, Tensor):
                costs = ssd_exhaustive(z, torch.where(zone, template, 0), zone)
            else:
                costs = z(template[None], zone)[0]
            found.append(costs[own[:, 1], own[:, 2]])
        return torch.cat(found), torch.arange(len(self.allowed), device=self.allowed.device)


@dataclass(frozen=True)
class Quick:
    """The best few places, by cells of a quadtree pyramid that are known whole.

    Args:
        fft: what is asked where no cell is known whole.
        pyramids: of every source.
    """

    fft: Everywhere
    pyramids: Sequence["_Pyramid"]

    def places(self) -> Int[Tensor, "n 3"]:
        """All places."""
        return self.fft.places()

    def __call__(
        self,
        template: Float[Tensor, "c s s"],
        zone: Bool[Tensor, "s s"],
        dearer: Float[Tensor, "m"],
    ) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
        if not bool(self.pyramids[0].whole(0, zone).any()):
            return self.fft(template, zone, dearer)
        found = [pyramid.search(template, zone, dearer) for pyramid in self.pyramids]
        return torch.cat([f[0] for f in found]), torch.cat([f[1] for f in found])


@dataclass(frozen=True)
class _Pyramid:
    """Cells of all places of one source, for a full patch; a zone is a choice of cells."""

    start: int  # number of the first place
    index: QtpIndex
    keys: Float[Tensor, "n d"]  # at the coarsest level
    squares: Float[Tensor, "n d"]

    def whole(self, level: int, zone: Tensor) -> Bool[Tensor, "k"]:
        """The cells of a level that lie in the zone."""
        cells = self.index.levels[level].cells
        table = torch.nn.functional.pad(zone.long().cumsum(0).cumsum(1), (1, 0, 1, 0))
        row, col, height, width = cells.T
        below, right = row + height, col + width
        inside = table[below, right] - table[row, right] - table[below, col] + table[row, col]
        return inside == height * width

    def search(self, template: Tensor, zone: Tensor, dearer: Tensor) -> tuple[Tensor, Tensor]:
        """Costs and numbers of the best few."""
        index, channels = self.index, len(template)
        dearer = dearer[self.start : self.start + len(index.places)]
        t = torch.where(zone, template - index.mean, 0)[None]
        query, part = self._query(0, t, zone, channels)
        known = query * part
        costs = self.squares @ part - 2 * (self.keys @ known) + query @ known
        costs = costs.clamp(min=0) * dearer
        found = costs.topk(min(index.keep[0], len(costs)), largest=False).indices.sort().values
        for level, count in enumerate((*index.keep[1:], index.keep[-1]), start=1):
            query, part = self._query(level, t, zone, channels)
            chosen = part.nonzero()[:, 0]
            keys = index.levels[level].at(index.places[found])[:, chosen]
            costs = (keys - query[chosen]).square().sum(1)
            order = (costs * dearer[found]).sort(stable=True).indices[:count]
            costs, found = costs[order], found[order]
        return costs, self.start + found

    def _query(self, level: int, t: Tensor, zone: Tensor, channels: int) -> tuple[Tensor, Tensor]:
        """Cell values of a template, and 1 for those of cells in the zone."""
        query = self.index.levels[level].of(t, summed_area(t))[0]
        return query, self.whole(level, zone).to(query).repeat(channels)


def _pyramid(qtp: Qtp, z: Tensor, mask: Tensor | None, start: int, side: int) -> _Pyramid:
    full = torch.ones(side, side, dtype=torch.bool, device=z.device)
    index = qtp.fit(z, full, mask)
    keys = index.levels[0].at(index.places)
    return _Pyramid(start, index, keys, keys.square())
