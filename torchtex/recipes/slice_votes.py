"""Slices of a volume matched, and voxels made of the matches: the two half-steps of a solid.

Every voxel is a weighted mean of what its windows in three directions say, or the exemplar pixel
that agrees best with it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.neighborhoods import falloff
from torchtex.quadratic import rowwise_sum
from torchtex.recipes.slice_models import SOFT, SliceModel
from torchtex.volumes.slices import Group, Windows

MOST_PRICED = 2**15
"""Prices of neighborhoods are made from about so many windows."""

EVEN = 1.0
"""Times the mean squared distance that is added to each in a robust weight: slices in one
direction that match exactly would else overrule the two others for good."""

NEAR = 1e-2
"""Squared distances of colours below this count as equal: the heavier window is copied."""

Prices = Mapping[int, Float[Tensor, "m"]]
"""Of the keys of each model, by its first pixel."""

Fields = Mapping[int, Int[Tensor, "d h w"]]
"""Pixel, in the table, that every voxel takes from the slices across each axis."""


@dataclass(frozen=True)
class Matched:
    """Windows of one group with their matches.

    Args:
        group: where they are.
        width: of the exemplar.
        places: (slices, rows, columns) of windows, the first pixel of the match in the table.
        weights: the robust weight of each window.
    """

    group: Group
    width: int
    places: Int[Tensor, "n ny nx"]
    weights: Float[Tensor, "n ny nx"]

    def at(self, row: int, col: int) -> Int[Tensor, "v"]:
        """Pixels of the table that lie at (row, column) of every window."""
        return (self.places + (row * self.width + col)).flatten()


def prices_of(
    volume: Float[Tensor, "d h w k"],
    sides: Sequence[tuple[SliceModel, Group]],
    completeness: float,
) -> Prices:
    """Prices of the neighborhoods of all exemplars: cheap where no window is near."""
    found = {}
    for first, model in {model.first: model for model, _ in sides}.items():
        mine = [group for other, group in sides if other is model]
        sample = torch.cat(list(_sampled(volume, model, mine))) if completeness else model.keys
        found[first] = model.prices(sample, completeness)
    return found


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
        yield model.queries(volume, group)[::step]


def match(
    volume: Float[Tensor, "d h w k"],
    sides: Sequence[tuple[SliceModel, Group]],
    prices: Prices,
    fields: Fields | None = None,
    *,
    r: float,
) -> tuple[list[Matched], float, int]:
    """The M-step: every window of all groups matched.

    Args:
        fields: what windows choose from (see `SliceModel.proposed`); all keys without it.

    Returns:
        The matches, the sum of distance^r, and the number of windows.
    """
    models = {model.first: model for model, _ in sides} if fields is None else {}
    index = {first: model.search(prices[first]) for first, model in models.items()}
    labels, squares = [], []
    for model, group in sides:
        queries = model.queries(volume, group)
        if fields is None:
            label, squared = index[model.first].match(queries)
        else:
            near = model.proposed(group, fields[group.axis])
            label, squared = model.nearest(queries, near, prices[model.first])
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
        width = model.lookup.shape[1]
        found.append(Matched(group, width, model.places[label].view(shape), weights))
    return found, energy, count


def averaged(
    matches: Sequence[Matched],
    table: Float[Tensor, "t k"],
    share: Float[Tensor, "t"],
    extent: Sequence[int],
) -> Float[Tensor, "d h w k"]:
    """The E-step: every voxel the weighted mean of what its windows in all directions say.

    Args:
        matches: of all groups.
        table: pixels of all exemplars.
        share: weight of each of them, less where its colours are too frequent.
        extent: of the volume.

    Source: Kopf et al. 2007, sections 3.1 and 3.2.
    """
    k = table.shape[1]
    weighed = torch.cat([table * share[:, None], share[:, None]], 1)
    total = table.new_zeros(*extent, k + 1)
    for one in matches:
        windows, shape = one.group.windows, (*one.places.shape, k + 1)
        profile = falloff(windows.size).to(table)
        sums = table.new_zeros(shape[0], *windows.padded, k + 1)
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
) -> tuple[Int[Tensor, "d h w"], Int[Tensor, "d h w"], Fields]:
    """The exemplar pixel for every voxel: near the mean, and heavy.

    Means over three directions are blurred; of the pixels that went into one, that which is
    nearest to it, by |pixel - mean|^2 / weight, is as sharp as the exemplar.

    Returns:
        Pixel in the table, the axis of the slice that it came from, and the best pixels of the
        slices across each axis alone.

    Source: the discrete solver of Han et al. 2006; for solids Chen and Wang 2010.
    """
    fields, best = {}, mean.new_full(mean.shape[:3], float("inf"))
    pixel = torch.zeros_like(best, dtype=torch.long)
    axis = torch.zeros_like(pixel)
    for across in sorted({one.group.axis for one in matches}):
        own = [one for one in matches if one.group.axis == across]
        cost, fields[across] = _said(own, table, mean, weights)
        wins = cost < best
        best = torch.where(wins, cost, best)
        pixel = torch.where(wins, fields[across], pixel)
        axis = torch.where(wins, across, axis)
    return pixel, axis, fields


def _said(
    matches: Sequence[Matched], table: Tensor, mean: Tensor, weights: Tensor
) -> tuple[Float[Tensor, "d h w"], Int[Tensor, "d h w"]]:
    """For every voxel the least cost of a pixel in the slices across one axis, and that pixel."""
    best = mean.new_full((*mean.shape[:3], 1), float("inf"))
    pixel = torch.zeros_like(best, dtype=torch.long)
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
        one.group.of(best)[..., 0].copy_(cost)
        one.group.of(pixel)[..., 0].copy_(source)
    return best[..., 0], pixel[..., 0]


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
