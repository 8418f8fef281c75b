"""Slices of a volume matched with exemplars, and voxels made of the matches: the two half-steps.

A volume under work is (d, h, w, k) with the channels last. Every window of every slice across an
axis is matched with a neighborhood of the exemplar for that axis; then every voxel is a weighted
mean of what its windows in three directions say, or the exemplar pixel that agrees best with it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchtex.label_spaces import label_space, strips
from torchtex.matching import Exact, principal_axes
from torchtex.neighborhoods import falloff
from torchtex.quadratic import rowwise_sum
from torchtex.volumes.histograms import excess
from torchtex.volumes.slices import Group, Windows

MOST_KEYS = 2**14
"""Of a larger exemplar so many neighborhoods are drawn at random."""

MOST_PRICED = 2**15
"""Prices of neighborhoods are made from about so many windows."""

SOFT = 1e-3
"""Squared distances of windows below this count as equal, so that no weight is infinite."""

EVEN = 1.0
"""Times the mean squared distance that is added to each in a robust weight: slices in one
direction that match exactly would else overrule the two others for good."""

NEAR = 1e-2
"""Squared distances of colours below this count as equal: the heavier window is copied."""


@dataclass(frozen=True)
class SliceModel:
    """An exemplar made ready for slices; all slices and axes that follow it share it.

    Args:
        starts: first pixel of each neighborhood, in the table of the pixels of all exemplars.
        width: of the exemplar.
        size: of the windows.
        profile: weight of each value of a window.
        mean, axes: of the neighborhoods; queries are reduced to these axes.
        keys: the neighborhoods, reduced.
    """

    starts: Int[Tensor, "m"]
    width: int
    size: int
    profile: Float[Tensor, "e"]
    mean: Float[Tensor, "e"]
    axes: Float[Tensor, "e q"]
    keys: Float[Tensor, "m q"]

    def reduced(self, windows: Float[Tensor, "n e"]) -> Float[Tensor, "n q"]:
        """Windows on the principal axes."""
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

        norms = self.keys.square().sum(1)
        priced = torch.stack([prices, prices * norms], 1)
        table = torch.cat([priced, -2 * prices[:, None] * self.keys], 1)
        index = faiss.IndexFlatIP(table.shape[1])
        index.add(_array(-table))
        return PricedKeys(index, self.keys)


@dataclass(frozen=True)
class PricedKeys:
    """Keys of which each has a price, in a faiss index."""

    index: Any
    keys: Float[Tensor, "m q"]

    def match(self, queries: Float[Tensor, "n q"]) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
        """The cheapest key of each query, and its squared distance."""
        import faiss

        faiss.omp_set_num_threads(torch.get_num_threads())
        norms = queries.square().sum(1, keepdim=True)
        sought = _array(torch.cat([norms, torch.ones_like(norms), queries], 1))
        labels = torch.from_numpy(self.index.search(sought, 1)[1][:, 0]).to(queries.device)
        return labels, (queries - self.keys[labels]).square().sum(1)


def _array(x: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(x.detach().cpu().numpy(), dtype=np.float32)


def slice_model(
    image: Float[Tensor, "k h w"],
    first: int,
    size: int,
    weights: Float[Tensor, "k"],
    dimensions: int,
    generator: torch.Generator,
) -> SliceModel:
    """Fits one exemplar.

    Args:
        image: of the level, with its maps as further channels.
        first: place of its first pixel in the table of all exemplars.
        size: of the windows.
        weights: of the channels in a comparison.
        dimensions: principal axes that are kept.
        generator: for the axes, and for the choice of keys where there are many.
    """
    height, width = image.shape[1:]
    space = label_space([(height, width)], size, device=image.device)
    chosen = torch.arange(len(space))
    if len(space) > MOST_KEYS:
        chosen = torch.randperm(len(space), generator=generator)[:MOST_KEYS].sort().values
    row, col = space.positions[chosen, 1:].unbind(1)
    profile = (falloff(size).to(image).flatten()[:, None] * weights).sqrt().flatten()
    vectors = strips([image], space, size).patches(chosen) * profile
    mean = vectors.mean(0)
    axes = principal_axes(vectors, dimensions, generator)
    keys = (vectors - mean) @ axes
    return SliceModel(first + row * width + col, width, size, profile, mean, axes, keys)


@dataclass(frozen=True)
class Matched:
    """Windows of one group with their matches.

    Args:
        group: where they are.
        model: that they were matched with.
        places: (slices, rows, columns) of windows, the first pixel of the match in the table.
        weights: the robust weight of each window.
    """

    group: Group
    model: SliceModel
    places: Int[Tensor, "n ny nx"]
    weights: Float[Tensor, "n ny nx"]

    def at(self, row: int, col: int) -> Int[Tensor, "v"]:
        """Pixels of the table that lie at (row, column) of every window."""
        return (self.places + (row * self.model.width + col)).flatten()


def match(
    volume: Float[Tensor, "d h w k"],
    sides: Sequence[tuple[SliceModel, Group]],
    *,
    completeness: float,
    r: float,
) -> tuple[list[Matched], float, int]:
    """The M-step: every window of all groups matched.

    Returns:
        The matches, the sum of distance^r, and the number of windows.
    """
    models = {id(model): model for model, _ in sides}
    keys = {}
    for name, model in models.items():
        mine = [group for other, group in sides if id(other) == name]
        sample = torch.cat(list(_sampled(volume, model, mine)))
        keys[name] = model.search(model.prices(sample, completeness))
    labels, squares = [], []
    for model, group in sides:
        windows = group.windows.gather(group.of(volume))
        label, squared = keys[id(model)].match(model.reduced(windows))
        labels.append(label)
        squares.append(squared)
    count = sum(len(squared) for squared in squares)
    energy = sum(float(rowwise_sum((s + SOFT).pow(r / 2))) for s in squares)
    mean = sum(float(rowwise_sum(s)) for s in squares) / count
    soft = SOFT + EVEN * mean
    found = []
    for (model, group), label, squared in zip(sides, labels, squares, strict=True):
        shape = (-1, *group.windows.shape)
        weights = (squared + soft).pow(r / 2 - 1).view(shape)
        found.append(Matched(group, model, model.starts[label].view(shape), weights))
    return found, energy, count


def _sampled(
    volume: Tensor, model: SliceModel, groups: Sequence[Group]
) -> Iterator[Float[Tensor, "n q"]]:
    """Queries of some windows, spread over all groups."""
    total = sum(
        group.of(volume).shape[0] * group.windows.shape[0] * group.windows.shape[1]
        for group in groups
    )
    step = max(1, total // MOST_PRICED)
    for group in groups:
        yield model.reduced(group.windows.gather(group.of(volume))[::step])


def averaged(
    matches: Sequence[Matched],
    table: Float[Tensor, "t k"],
    volume: Float[Tensor, "d h w k"],
    histogram: float,
) -> Float[Tensor, "d h w k"]:
    """The E-step: every voxel the weighted mean of what its windows in all directions say.

    Args:
        matches: of all groups.
        table: pixels of all exemplars.
        volume: whose histogram is compared with that of the table.
        histogram: how strongly values that are too frequent lose weight; 0: not at all.

    Source: Kopf et al. 2007, sections 3.1 and 3.2.
    """
    k = table.shape[1]
    share = 1 / (1 + histogram * excess(table.T, volume.flatten(0, 2).T))
    weighed = torch.cat([table * share[:, None], share[:, None]], 1)
    total = volume.new_zeros(*volume.shape[:3], k + 1)
    for one in matches:
        windows, shape = one.group.windows, (*one.places.shape, k + 1)
        profile = falloff(windows.size).to(volume)
        sums = volume.new_zeros(shape[0], *windows.padded, k + 1)
        for i, j in windows.places():  # one place at a time: no two meet in one addition
            said = weighed.index_select(0, one.at(i, j)).view(shape)
            windows.at(sums, i, j).add_(said * (one.weights * profile[i, j])[..., None])
        one.group.of(total).add_(windows.fold(sums))
    return total[..., :k] / total[..., k:]


def snapped(
    matches: Sequence[Matched],
    table: Float[Tensor, "t k"],
    mean: Float[Tensor, "d h w k"],
    weights: Float[Tensor, "k"],
) -> tuple[Int[Tensor, "d h w"], Int[Tensor, "d h w"]]:
    """The exemplar pixel for every voxel: near the mean, and heavy.

    Means over three directions are blurred; of the pixels that went into one, that which is
    nearest to it, by |pixel - mean|^2 / weight, is as sharp as the exemplar.

    Returns:
        Pixel in the table, and the axis of the slice that it came from.

    Source: the discrete solver of Han et al. 2006; for solids Chen and Wang 2010.
    """
    best = mean.new_full((*mean.shape[:3], 1), float("inf"))
    pixel = torch.zeros_like(best, dtype=torch.long)
    axis = torch.zeros_like(pixel)
    for one in matches:
        windows, shape = one.group.windows, one.places.shape
        profile = falloff(windows.size).to(mean)
        wanted = windows.pad(one.group.of(mean))
        cost = mean.new_full((shape[0], *windows.padded), float("inf"))
        source = torch.zeros_like(cost, dtype=torch.long)
        for i, j in windows.places():
            place = one.at(i, j)
            said = table.index_select(0, place).view(*shape, -1)
            gap = (said - windows.at(wanted, i, j)).square_() @ weights
            gap = (gap + NEAR) / (one.weights * profile[i, j])
            here, there = windows.at(cost, i, j), windows.at(source, i, j)
            wins = gap < here
            here.copy_(torch.where(wins, gap, here))
            there.copy_(torch.where(wins, place.view(shape), there))
        cost, source = _folded_least(windows, cost, source)
        old = one.group.of(best)[..., 0]
        wins = cost < old
        old.copy_(torch.where(wins, cost, old))
        for held, new in ((pixel, source), (axis, torch.full_like(source, one.group.axis))):
            view = one.group.of(held)[..., 0]
            view.copy_(torch.where(wins, new, view))
    return pixel[..., 0], axis[..., 0]


def _folded_least(windows: Windows, cost: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
    """As `Windows.fold`, but the lesser cost stays."""
    for dim, extent in ((1, windows.rows), (2, windows.cols)):
        over = cost.shape[dim] - extent
        near, far = cost.narrow(dim, 0, over), cost.narrow(dim, extent, over)
        wins = far < near
        held = source.narrow(dim, 0, over)
        held.copy_(torch.where(wins, source.narrow(dim, extent, over), held))
        near.copy_(torch.where(wins, far, near))
        shift = windows.offset[dim - 1]
        cost = cost.narrow(dim, 0, extent).roll(shift, dim)
        source = source.narrow(dim, 0, extent).roll(shift, dim)
    return cost, source
