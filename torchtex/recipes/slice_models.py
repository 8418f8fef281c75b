"""Exemplars made ready for the slices of a volume: keys, their prices, and two searches.

A volume under work is (d, h, w, k) with the channels last. Every window of every slice across an
axis is matched with a neighborhood of the exemplar for that axis: among all of them, or among
those that its surroundings propose.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchtex.features import Feature
from torchtex.label_spaces import label_space, strips
from torchtex.matching import Exact, principal_axes
from torchtex.neighborhoods import falloff
from torchtex.volumes.slices import Group

MOST_KEYS = 2**14
"""Of a larger exemplar so many neighborhoods, drawn at random, are searched; all are proposed."""

SOFT = 1e-3
"""Squared distances of windows below this count as equal, so that no weight is infinite."""

PART = 2**13
"""Windows that are compared with proposals at a time: their keys fit into a cache."""


@dataclass(frozen=True)
class SliceModel:
    """An exemplar made ready for slices; all slices and axes that follow it share it.

    Args:
        first: place of its first pixel in the table of the pixels of all exemplars.
        places: first pixel of each neighborhood, in that table.
        lookup: number of the neighborhood that begins at each pixel, or of one close by.
        size: of the windows.
        roots: of the weights of the channels.
        feature: what is compared.
        profile: weight of each value of a window.
        mean, axes: of the neighborhoods; queries are reduced to these axes.
        keys: the neighborhoods, reduced.
        searched: numbers of those that a search goes through.
    """

    first: int
    places: Int[Tensor, "m"]
    lookup: Int[Tensor, "hz wz"]
    size: int
    roots: Float[Tensor, "k"]
    feature: Feature
    profile: Float[Tensor, "e"]
    mean: Float[Tensor, "e"]
    axes: Float[Tensor, "e q"]
    keys: Float[Tensor, "m q"]
    searched: Int[Tensor, "s"]

    def queries(self, volume: Float[Tensor, "d h w k"], group: Group) -> Float[Tensor, "n q"]:
        """The windows of a group, on the principal axes."""
        slices = group.of(volume) * self.roots
        pictures = [self.feature(one).permute(1, 2, 0) for one in slices.permute(0, 3, 1, 2)]
        windows = group.windows.gather(torch.stack(pictures))
        return (windows * self.profile - self.mean) @ self.axes

    def prices(self, queries: Float[Tensor, "n q"], completeness: float) -> Float[Tensor, "m"]:
        """What the distance to each key is multiplied by: a key that nobody comes near is cheap.

        1 / (median / completeness + min over q of |q - k|^2), the median that of the minima.

        Source: as `matching.complete_search`, from a sample of the queries.
        """
        if completeness == 0:
            return torch.ones_like(self.keys[:, 0])
        used = Exact().fit(queries).search(self.keys, 1)[0][:, 0]
        return 1 / (used + used.median() / completeness + SOFT / completeness)

    def search(self, prices: Float[Tensor, "m"]) -> "PricedKeys":
        """The keys made ready for search with their prices: price |q - k|^2 as an inner product."""
        import faiss  # after torch, so that one OpenMP runtime is already in place

        keys, prices = self.keys[self.searched], prices[self.searched]
        norms = keys.square().sum(1)
        priced = torch.stack([prices, prices * norms], 1)
        table = torch.cat([priced, -2 * prices[:, None] * keys], 1)
        index = faiss.IndexFlatIP(table.shape[1])
        index.add(_array(-table))
        return PricedKeys(index, self)

    def proposed(self, group: Group, field: Int[Tensor, "d h w"]) -> list[Int[Tensor, "n"]]:
        """Keys that windows of a group would have, did they go on as one of their voxels does.

        The voxel at the middle of a window is asked in the slices in front and behind too.

        Args:
            field: pixel, in the table, that every voxel takes from the slices of this axis.

        Source: coherent candidates, Ashikhmin 2001; here across slices too.
        """
        ends, middle = (0, self.size // 2, self.size - 1), self.size // 2
        spots = [(i, j, 0) for i in ends for j in ends]
        spots += [(middle, middle, step) for step in (-2, -1, 1, 2)]
        found = []
        for i, j, step in spots:
            slices = group.windows.pad(group.of(field.roll(step, group.axis)[..., None]))
            said = group.windows.at(slices, i, j).flatten() - self.first
            width = self.lookup.shape[1]
            row = torch.div(said, width, rounding_mode="floor") - i
            col = said % width - j
            row.clamp_(0, len(self.lookup) - 1)
            found.append(self.lookup[row, col.clamp_(0, width - 1)])
        return found

    def nearest(
        self,
        queries: Float[Tensor, "n q"],
        proposals: Sequence[Int[Tensor, "n"]],
        prices: Float[Tensor, "m"],
    ) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
        """The cheapest proposal of each query, and its squared distance."""
        labels, squares = [], []
        for start in range(0, len(queries), PART):
            part = queries[start : start + PART]
            best = part.new_full((len(part),), float("inf"))
            label, square = torch.zeros_like(proposals[0][: len(part)]), best.clone()
            for proposal in proposals:
                key = proposal[start : start + PART]
                squared = (part - self.keys[key]).square_().sum(1)
                cost = squared * prices[key]
                wins = cost < best
                best = torch.where(wins, cost, best)
                label = torch.where(wins, key, label)
                square = torch.where(wins, squared, square)
            labels.append(label)
            squares.append(square)
        return torch.cat(labels), torch.cat(squares)


@dataclass(frozen=True)
class PricedKeys:
    """Keys of which each has a price, in a faiss index."""

    index: Any
    model: SliceModel

    def match(self, queries: Float[Tensor, "n q"]) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
        """The cheapest key of each query, and its squared distance."""
        import faiss

        faiss.omp_set_num_threads(torch.get_num_threads())
        norms = queries.square().sum(1, keepdim=True)
        sought = _array(torch.cat([norms, torch.ones_like(norms), queries], 1))
        found = torch.from_numpy(self.index.search(sought, 1)[1][:, 0]).to(queries.device)
        labels = self.model.searched[found]
        return labels, (queries - self.model.keys[labels]).square().sum(1)


def _array(x: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(x.detach().cpu().numpy(), dtype=np.float32)


def slice_model(
    image: Float[Tensor, "k h w"],
    mask: Bool[Tensor, "h w"] | None,
    first: int,
    size: int,
    weights: Float[Tensor, "k"],
    feature: Feature,
    dimensions: int,
    generator: torch.Generator,
) -> SliceModel:
    """Fits one exemplar.

    Args:
        image: of the level, with its maps as further channels.
        mask: True where it may be used.
        first: place of its first pixel in the table of all exemplars.
        size: of the windows.
        weights: of the channels in a comparison.
        feature: what is compared.
        dimensions: principal axes that are kept.
        generator: for the axes, and for the choice of keys where there are many.
    """
    height, width = image.shape[1:]
    space = label_space([(height, width)], size, [mask], device=image.device)
    every = torch.arange(len(space))
    searched = every
    if len(space) > MOST_KEYS:
        searched = torch.randperm(len(space), generator=generator)[:MOST_KEYS].sort().values
    row, col = space.positions[:, 1:].unbind(1)
    roots = weights.sqrt()
    compared = feature(image * roots[:, None, None])
    profile = falloff(size).to(image).sqrt().flatten().repeat_interleave(len(compared))
    vectors = strips([compared], space, size).patches(every) * profile
    mean = vectors.mean(0)
    axes = principal_axes(vectors, dimensions, generator)
    keys = (vectors - mean) @ axes
    return SliceModel(
        first, first + row * width + col, filled(space.tables[0]), size, roots, feature, profile,
        mean, axes, keys, searched,
    )  # fmt: skip


def filled(table: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """A table of numbers whose gaps (-1) take a number close by.

    Example:
        >>> filled(torch.tensor([[-1, 4, -1, -1, 7]])).tolist()
        [[4, 4, 4, 7, 7]]
    """
    table = table.clone()
    assert bool((table >= 0).any())
    while bool((table < 0).any()):
        old = table.clone()
        for dim in (0, 1):
            for to, of in ((0, 1), (1, 0)):
                here = table.narrow(dim, to, table.shape[dim] - 1)
                there = old.narrow(dim, of, table.shape[dim] - 1)
                here.copy_(torch.where(here < 0, there, here))
    return table
