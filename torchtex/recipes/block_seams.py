"""Seams between pieces of a montage of square blocks, moved to where they show least.

Source: Kwatra et al. 2003, for the cost of a seam; Boykov et al. 2001, for the moves.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.cuts.expansion import expand
from torchtex.cuts.mincut import MinCut
from torchtex.label_spaces import LabelSpace

STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0), (0, 2), (2, 0), (0, -2), (-2, 0),
         (0, 4), (4, 0), (0, -4), (-4, 0))  # fmt: skip
"""Blocks by which pieces are offered to grow, one move after another."""


@dataclass(frozen=True)
class BlockSeams:
    """What it costs that neighboring blocks are from different pieces.

    Args:
        space: places of blocks, numbered.
        side: pixels of a block along each axis.
        periodic: blocks at opposite borders are neighbors.
        looks: of the block at each place, four parts of it.
        after: label of the place one block to the right, below, to the left, above; or -1.
        blind: cost of a pair that has nothing to be compared with.
    """

    space: LabelSpace
    side: int
    periodic: bool
    looks: Float[Tensor, "m d"]
    after: tuple[Tensor, Tensor, Tensor, Tensor]
    blind: float

    def moved(
        self,
        places: Int[Tensor, "y x 3"],
        solver: MinCut | None,
        report: Callable[[int, float], None],
    ) -> Int[Tensor, "y x"]:
        """Labels of blocks, after every piece was offered to grow over its neighbors."""
        labels = self.space.at(places).flatten()
        edges, across = self._edges(places.shape[:2], labels.device)
        first, second = labels[edges].unbind(1)
        total = float(self._pairs(first, second, across).double().sum())

        def free(labels: Tensor) -> Tensor:
            return self.looks.new_zeros(len(labels))

        for number, step in enumerate(STEPS):
            offer = self._shifted(labels.view(places.shape[:2]), step).flatten()
            near = (offer != labels)[edges].any(1)  # all else cannot change
            if not bool(near.any()):
                continue
            nodes, ends = torch.unique(edges[near], return_inverse=True)
            count = int(near[:across].sum())
            labels[nodes], energies = expand(
                labels[nodes], offer[None, nodes], free, ends,
                lambda one, other, count=count: self._pairs(one, other, count),
                solver=solver, sweeps=1,
            )  # fmt: skip
            total += energies[-1] - energies[0]
            report(number, total)
        return labels.view(places.shape[:2])

    def _pairs(self, first: Tensor, second: Tensor, across: int) -> Tensor:
        """Of pairs of neighbors, of which the first ones lie side by side."""
        right = self._costs(first[:across], second[:across], 0)
        return torch.cat([right, self._costs(first[across:], second[across:], 1)])

    def _costs(self, first: Tensor, second: Tensor, axis: int) -> Tensor:
        """Of pairs along one axis: 0 where the second goes on where the first ends."""
        costs = self.looks.new_zeros(len(first))
        unlike = (self.after[axis][first] != second).nonzero()[:, 0]
        a, b = first[unlike], second[unlike]
        beyond, before = self.after[axis][a], self.after[axis + 2][b]
        looks = self.looks
        there = (looks[beyond.clamp(min=0)] - looks[b]).square().sum(1)
        here = (looks[before.clamp(min=0)] - looks[a]).square().sum(1)
        cost = torch.where(beyond < 0, here, there) + torch.where(before < 0, there, here)
        costs[unlike] = torch.where((beyond < 0) & (before < 0), self.blind, cost)
        return costs

    def _edges(self, size: Sequence[int], device: torch.device) -> tuple[Tensor, int]:
        """Neighbors to the right, then below, and how many the first are."""
        h, w = size
        number = torch.arange(h * w, device=device).view(h, w)
        wraps = self.periodic
        pairs = []
        for dim in (1, 0):
            count = number.shape[dim] - (0 if wraps and number.shape[dim] > 2 else 1)
            first, second = number, number.roll(-1, dim)
            both = [x.narrow(dim, 0, count).flatten() for x in (first, second)]
            pairs.append(torch.stack(both, 1))
        return torch.cat(pairs), len(pairs[0])

    def _shifted(self, labels: Int[Tensor, "y x"], step: tuple[int, int]) -> Tensor:
        """For each block what continues the piece some blocks away; its own if that is nothing."""
        places = self.space.positions.to(labels.device)[labels]
        lines, apart = [], []
        for extent, by in zip(labels.shape, step, strict=True):
            here = torch.arange(extent, device=labels.device)
            wraps = self.periodic
            there = (here + by) % extent if wraps else (here + by).clamp(0, extent - 1)
            lines.append(there)
            apart.append(torch.full_like(here, by) if wraps else there - here)
        found = places[lines[0][:, None], lines[1]]
        found[..., 1] -= apart[0][:, None] * self.side
        found[..., 2] -= apart[1] * self.side
        offer = self.space.at(found)
        return torch.where(offer < 0, labels, offer)


def block_seams(
    exemplars: Sequence[Float[Tensor, "c _ _"]], space: LabelSpace, side: int, periodic: bool
) -> BlockSeams:
    """The costs of seams between blocks of exemplars.

    Args:
        space: every place of a block of `side` pixels.

    Example:
        >>> from torchtex.label_spaces import label_space
        >>> seams = block_seams([torch.rand(3, 8, 8)], label_space([(8, 8)], 2), 2, False)
        >>> seams.looks.shape
        torch.Size([49, 12])
    """
    half = side // 2
    parts = []
    for z, table in zip(exemplars, space.tables, strict=True):
        mean = F.avg_pool2d(z[None], half, 1)[0]
        h, w = z.shape[1] - side + 1, z.shape[2] - side + 1
        corners = [(i, j) for i in (0, half) for j in (0, half)]
        block = torch.cat([mean[:, i : i + h, j : j + w] for i, j in corners])
        parts.append(block[:, table[:h, :w] >= 0].T * half)
    looks = torch.cat(parts)
    directions = ((0, 0, side), (0, side, 0), (0, 0, -side), (0, -side, 0))
    place = space.positions
    right, down, left, up = (space.at(place + place.new_tensor(by)) for by in directions)
    blind = 4 * float(looks.var(0, correction=0).sum()) + 1e-6
    return BlockSeams(space, side, periodic, looks, (right, down, left, up), blind)
