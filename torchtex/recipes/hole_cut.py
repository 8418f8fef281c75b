"""Which known pixel every pixel of a hole is copied from: min-cuts among offsets.

The cost of a seam between neighbors is how unlike their sources are at both of them, as far as they
are known; neighbors that are copied together cost nothing.

Source: Pritch et al. 2009, shift maps; Kwatra et al. 2003 (cost of a seam).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchtex.cuts.expansion import Move, expand
from torchtex.cuts.mincut import MinCut
from torchtex.cuts.poisson import Guidance
from torchtex.recipes.levelling import levelled
from torchtex.sources import pixel_places

_SWEEPS = 2  # after the first, of the offsets that helped in it
_NEAR = 6  # pixels around one that say how flat an image is there
_UNSEEN = 2.0  # cost of a seam where neither side has a known pixel to compare


@dataclass(frozen=True)
class Hole:
    """A hole and what surrounds it. A place is a pixel of it; a label is its number, row by row.

    Args:
        image: the pixels.
        known: those that may be copied.
        target: those of the hole.

    Example:
        >>> image, target = torch.arange(4.0).expand(1, 4, 4), torch.eye(4) > 0
        >>> places = pixel_places((4, 4), torch.device("cpu"))
        >>> Hole(image, ~target, target).moved(places + 1)[0].tolist()
        [1, 1]
    """

    image: Float[Tensor, "c h w"]
    known: Bool[Tensor, "h w"]
    target: Bool[Tensor, "h w"]

    def moved(self, places: Int[Tensor, "h w 2"], rim: int | None = None) -> Int[Tensor, "n 2"]:
        """Offsets of all pixels of the hole, or of those so near its rim."""
        chosen = self.target
        if rim is not None:
            outside = F.max_pool2d((~self.target)[None].float(), 2 * rim + 1, 1, rim)[0] > 0
            chosen = chosen & outside
        return (places - pixel_places(self.known.shape, places.device))[chosen]

    def cut(
        self,
        places: Int[Tensor, "h w 2"],
        offered: Int[Tensor, "k 2"],
        border: float,
        detail: float,
        solver: MinCut,
        on_step: Callable[[Move], None] | None,
    ) -> Int[Tensor, "h w 2"]:
        """Places that agree with their neighbors, of the first and the offered ones."""
        graph = self._graph(border, detail)
        labels = torch.where(graph.fixed, graph.own, _flat(places, graph.width)[graph.nodes])
        rows = torch.stack([graph.row(offset, self.known) for offset in offered])
        helped: set[int] = set()

        def told(move: Move) -> None:
            if move.changed:
                helped.add(move.proposal)
            if on_step is not None:
                on_step(move)

        def moved(labels: Tensor, rows: Tensor, sweeps: int) -> Tensor:
            return expand(
                labels, rows, graph.unary, graph.edges, graph.pairwise,
                solver=solver, sweeps=sweeps, on_step=told,
            )[0]  # fmt: skip

        labels = moved(labels, rows, 1)
        labels = moved(labels, rows[sorted(helped)], _SWEEPS)
        found = pixel_places(self.known.shape, labels.device)
        found[graph.nodes] = torch.stack([labels // graph.width, labels % graph.width], 1)
        return found

    def _graph(self, border: float, detail: float) -> "_Graph":
        h, w = self.known.shape
        nodes = F.max_pool2d(self.target[None].float(), 3, 1, 1)[0] > 0  # the hole and its ring
        fixed = ~self.target[nodes]
        number = torch.full((h, w), -1, device=nodes.device)
        number[nodes] = torch.arange(len(fixed), device=nodes.device)
        pairs = [torch.stack(_ends(number, axis), -1).view(-1, 2) for axis in (1, 0)]
        pairs = [p[(p >= 0).all(1) & ~fixed[p].all(1)] for p in pairs]
        edges = torch.cat(pairs)
        weight = torch.where(fixed[edges].any(1), border, 1.0).to(self.image)
        cost = (detail * self.flatness()).masked_fill(~self.known, torch.inf).flatten()
        return _Graph(
            nodes, fixed, _flat(nodes.nonzero(), w), edges, len(pairs[0]), weight, cost,
            self._views(), w,
        )  # fmt: skip

    def flatness(self) -> Float[Tensor, "h w"]:
        """How much less than around the hole an image changes from pixel to pixel, 0 to 1."""
        steps, counts = torch.zeros_like(self.image[0]), torch.zeros_like(self.image[0])
        for axis in (0, 1):
            one, other = _ends(self.known, axis)
            both = (one & other).to(self.image)
            step = self.image.diff(dim=axis + 1).square().sum(0).sqrt() * both
            steps.narrow(axis, 0, step.shape[axis]).add_(step)
            counts.narrow(axis, 0, step.shape[axis]).add_(both)
        wide = 2 * _NEAR + 1
        local, count = (
            F.avg_pool2d(x[None, None], wide, 1, _NEAR, count_include_pad=True)[0, 0]
            for x in (steps, counts)
        )
        local = local / count.clamp(min=1e-6)
        rim = self.known & (F.max_pool2d(self.target[None].to(local), 2 * wide + 1, 1, wide)[0] > 0)
        usual = local[rim if bool(rim.any()) else self.known].mean()
        return (1 - local / usual.clamp(min=1e-6)).clamp(0, 1)

    def pixels(
        self, places: Int[Tensor, "h w 2"], *, poisson: bool = False
    ) -> Float[Tensor, "c h w"]:
        """The pixels of those places; with `poisson`, levelled along the seams."""
        pasted = self.image[:, places[..., 0], places[..., 1]]
        if not poisson:
            return pasted
        labels, views = _flat(places, self.known.shape[1]), self._views()
        right, down = (_slope(views, *_ends(labels, axis), view) for axis, view in ((1, 1), (0, 2)))
        return levelled(pasted, Guidance(right, down), self.target)

    def _views(self) -> Float[Tensor, "5 n k"]:
        """Channels and 1 where known: at a pixel, and to its right, below, left and above it."""
        full = torch.cat([self.image, self.known[None].to(self.image)])
        wide = F.pad(full, (1, 1, 1, 1))
        h, w = self.known.shape
        steps = ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0))
        views = [wide[:, 1 + i : 1 + i + h, 1 + j : 1 + j + w].flatten(1).T for i, j in steps]
        return torch.stack(views)


@dataclass(frozen=True)
class _Graph:
    """Pixels of a hole and of the ring around it, which keeps its own labels."""

    nodes: Bool[Tensor, "h w"]
    fixed: Bool[Tensor, "n"]
    own: Int[Tensor, "n"]
    edges: Int[Tensor, "e 2"]
    split: int  # the edges before it go to the right, the others down
    weight: Float[Tensor, "e"]
    cost: Float[Tensor, "m"]  # of a label
    views: Float[Tensor, "5 m k"]
    width: int

    def row(self, offset: Int[Tensor, "2"], known: Bool[Tensor, "h w"]) -> Int[Tensor, "n"]:
        """Labels of one offset; where there is none, a pixel's own, which costs infinity."""
        place = self.nodes.nonzero() + offset
        exists = ((place >= 0) & (place < place.new_tensor(known.shape))).all(1) & ~self.fixed
        return torch.where(exists, _flat(place, self.width), self.own)

    def unary(self, labels: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Of flatness; infinite for what is not known."""
        return torch.where(self.fixed, torch.where(labels == self.own, 0, torch.inf),
                           self.cost[labels])  # fmt: skip

    def pairwise(self, first: Int[Tensor, "e"], second: Int[Tensor, "e"]) -> Float[Tensor, "e"]:
        """Of seams; 0 where neighbors are copied together."""
        split, w = self.split, self.width
        costs = torch.cat([
            _seam(self.views, first[:split], second[:split], 1),
            _seam(self.views, first[split:], second[split:], 2),
        ])  # fmt: skip
        step = torch.ones_like(first)
        step[split:] = w
        together = (second - first == step) & ((step == w) | (second % w > 0))
        return (self.weight * costs).masked_fill(together, 0)


def _seam(views: Tensor, one: Tensor, other: Tensor, view: int) -> Tensor:
    """How unlike both labels are at both pixels of an edge, as far as pixels are known."""
    gaps = counts = torch.zeros_like(views[0, one, 0])
    for a, b in (
        (views[0][one], views[view + 2][other]),
        (views[view][one], views[0][other]),
    ):
        both = a[:, -1] * b[:, -1]
        gaps = gaps + both * (a[:, :-1] - b[:, :-1]).square().sum(1).sqrt()
        counts = counts + both
    return torch.where(counts > 0, 2 * gaps / counts.clamp(min=1), _UNSEEN)


def _slope(
    views: Tensor, one: Int[Tensor, "a b"], other: Int[Tensor, "a b"], view: int
) -> Float[Tensor, "k a b"]:
    """Wanted difference along each edge: the mean of those at both sources, where known."""
    here, after = views[0][one], views[view][one]
    before, there = views[view + 2][other], views[0][other]
    first, second = here[..., -1:] * after[..., -1:], before[..., -1:] * there[..., -1:]
    slope = first * (after - here)[..., :-1] + second * (there - before)[..., :-1]
    return (slope / (first + second).clamp(min=1)).movedim(-1, 0)


def _flat(places: Int[Tensor, "*n 2"], width: int) -> Int[Tensor, "*n"]:
    return places[..., 0] * width + places[..., 1]


def _ends(x: Shaped[Tensor, "h w"], axis: int) -> tuple[Tensor, Tensor]:
    """The two ends of all edges along an axis."""
    n = x.shape[axis]
    return x.narrow(axis, 0, n - 1), x.narrow(axis, 1, n - 1)
