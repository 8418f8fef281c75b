"""Patch-based sampling: patches whose boundary zones fit, blended where they overlap.

Source: Liang et al. 2001, Real-time texture synthesis by patch-based sampling.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.inputs import (
    Exemplars,
    Masks,
    check_not_negative,
    check_seed,
    check_size,
    memory_of,
    usable_exemplars,
)
from torchtex.label_spaces import LabelSpace
from torchtex.layouts import Layout, costs_of_places, layout_of, places_of
from torchtex.patches import SsdSearch, ssd_exhaustive, ssd_search
from torchtex.picks import pick
from torchtex.qtp import Qtp, QtpIndex
from torchtex.quadratic import threads
from torchtex.recipes.montage import Montage, Stage
from torchtex.sources import SourceField, pixel_places

Search = Literal["exhaustive", "fft", "qtp"] | Qtp
_SHARE = 0.28  # of the exemplar's side is a patch's, unless given


def patchwise(
    exemplars: Exemplars,
    size: tuple[int, int],
    *,
    patch: int | None = None,
    overlap: int | None = None,
    tolerance: float = 0.1,
    search: Search = "fft",
    masks: Masks = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """A texture of square patches that fit those before them, and fade into each other.

    A patch is drawn from all whose boundary zone is near that of the texture, root mean square
    difference <= tolerance times root mean square of the texture there, or else is the nearest.
    Across an overlap the weight of a patch falls linearly; the weights of all add up to 1.

    Args:
        exemplars: one image, or several with equal channels.
        size: (height, width) of the texture.
        patch: side of a patch; None for 0.28 of the shortest side of the exemplars.
        overlap: width of the boundary zones; None for a sixth of the patch.
        tolerance: relative distance; the paper takes 0.2, for grey values far from 0.
        search: "fft" and "exhaustive" cost all places, by Fourier transforms and by definition;
            "qtp", or a `Qtp`, finds the best few, and the draw is among them.
        masks: True where an exemplar may be used; one per exemplar.
        on_step: called after every row of patches; may raise to cancel.

    Raises:
        ValueError: an option out of range, or a patch that fits nowhere.

    Example:
        >>> result = patchwise(torch.rand(3, 32, 32), (40, 50), patch=12, overlap=3)
        >>> result.texture.shape
        torch.Size([3, 40, 50])
    """
    started = time.perf_counter()
    zs, keep = usable_exemplars(exemplars, masks)
    check_size(size, memory_of(zs[0], size, images=6, numbers=40))
    layout = layout_of(zs, size, patch, overlap, share=_SHARE, name="patch")
    check_not_negative("tolerance", tolerance)
    check_seed(seed)
    space = places_of(zs, keep, layout.side, "patch")
    generator = torch.Generator().manual_seed(seed)
    with threads(1):  # the pieces are small
        finder = _finder(search, zs, space)
        field, patches = _laid(zs, space, layout, finder, tolerance, generator, on_step)
        texture = field.apply(zs)
    settings = {
        "recipe": "patchwise",
        "size": list(layout.size),
        "patch": layout.side,
        "overlap": layout.overlap,
        "tolerance": tolerance,
        "search": search if isinstance(search, str) else repr(search),
    }
    return Montage(texture, field, patches, time.perf_counter() - started, seed, settings)


Finder = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Costs and labels of places for a template (c, h, w), compared in a zone (h, w)."""


def _laid(
    zs: list[Tensor],
    space: LabelSpace,
    layout: Layout,
    finder: Finder,
    tolerance: float,
    generator: torch.Generator,
    on_step: Callable[[Stage], None] | None,
) -> tuple[SourceField, Int[Tensor, "h w"]]:
    """All patches, row by row. Those of one layer lie two apart, so they never meet."""
    first, side, step = zs[0], layout.side, layout.step
    (rows, cols), (height, width) = layout.count, layout.size
    places = space.positions.to(first.device)
    sums = first.new_zeros(len(first), *layout.extent)
    weights = first.new_zeros(4, *layout.extent)
    numbers = places.new_zeros(4, *layout.extent)
    origins = places.new_zeros(rows * cols, 3)
    for n in range(rows * cols):
        i, j = divmod(n, cols)
        window, zone = layout.window(i, j), layout.known(i, j, first.device)
        here = sums[:, window[0], window[1]]
        if n:
            template = here / weights[:, window[0], window[1]].sum(0).clamp(min=1e-9)
            costs, labels = finder(template, zone)
            label = labels[_near(costs, template[:, zone], tolerance, generator)]
        else:
            label = torch.randint(len(places), (1,), generator=generator)[0]
        origins[n] = places[label] - places.new_tensor([0, i * step, j * step])
        number, row, col = places[label].tolist()
        share = _ramp(layout, i, rows, first)[:, None] * _ramp(layout, j, cols, first)
        here += share * zs[number][:, row : row + side, col : col + side]
        layer = 2 * (i % 2) + j % 2
        weights[layer][window] = share
        numbers[layer][window] = n
        if on_step is not None and j == cols - 1:
            known = sums / weights.sum(0).clamp(min=1e-9)
            on_step(Stage((i + 1) / rows, "patches", known[:, :height, :width].contiguous()))
    used = weights.flatten(1).any(1)
    weights, numbers = weights[used, :height, :width], numbers[used, :height, :width]
    patches = numbers.gather(0, weights.argmax(0, keepdim=True))[0]
    numbers = torch.where(weights > 0, numbers, patches)  # an unused layer names a pixel too
    positions = origins[numbers]
    positions[..., 1:] += pixel_places((height, width), first.device)
    shapes = tuple((z.shape[1], z.shape[2]) for z in zs)
    return SourceField(positions, weights, shapes), patches


def _ramp(layout: Layout, place: int, count: int, like: Tensor) -> Float[Tensor, "n"]:
    """Weights along one axis of the patch at that place of so many."""
    weights = like.new_ones(layout.side)
    rise = torch.arange(1, layout.overlap + 1, device=like.device).to(like) / (layout.overlap + 1)
    if place > 0:
        weights[: layout.overlap] = rise
    if place < count - 1:
        weights[-layout.overlap :] = 1 - rise
    return weights


def _near(
    costs: Float[Tensor, "n"],
    known: Float[Tensor, "c m"],
    tolerance: float,
    generator: torch.Generator,
) -> int:
    """One of the places near enough, or the nearest."""
    near = (costs <= tolerance**2 * known.square().sum(1).sum()).nonzero()[:, 0]
    if not len(near):
        return pick(costs[None], 0.0, generator)[1]
    return int(near[int(torch.randint(len(near), (1,), generator=generator))])


def _finder(search: Search, zs: list[Tensor], space: LabelSpace) -> Finder:
    if search == "fft":
        return _Everywhere(space, tuple(ssd_search(z) for z in zs))
    if search == "exhaustive":
        return _Everywhere(space, tuple(zs))
    if search == "qtp":
        return _Quick(space, Qtp(), zs, {})
    if isinstance(search, Qtp):
        return _Quick(space, search, zs, {})
    raise ValueError(f"search={search!r} is unknown; choose exhaustive, fft or qtp")


@dataclass(frozen=True)
class _Everywhere:
    """Costs of all places."""

    space: LabelSpace
    exemplars: Sequence[SsdSearch | Tensor]

    def __call__(self, template: Tensor, zone: Tensor) -> tuple[Tensor, Tensor]:
        found = [
            ssd_exhaustive(z, template, zone)
            if isinstance(z, Tensor)
            else z(template[None], zone)[0]
            for z in self.exemplars
        ]
        costs = costs_of_places(self.space, found)
        return costs, torch.arange(len(costs))


@dataclass(frozen=True)
class _Quick:
    """The best few places of each exemplar; zones recur, so their indices are kept."""

    space: LabelSpace
    qtp: Qtp
    exemplars: list[Tensor]
    indices: dict[tuple[bool, bool], list[QtpIndex]]

    def __call__(self, template: Tensor, zone: Tensor) -> tuple[Tensor, Tensor]:
        kind = bool(zone[0, -1]), bool(zone[-1, 0])
        if kind not in self.indices:
            self.indices[kind] = [self.qtp.fit(z, zone) for z in self.exemplars]
        costs, labels = [], []
        for index, table in zip(self.indices[kind], self.space.tables, strict=True):
            cost, place = index.search(template[None], min(self.qtp.keep))
            label = table[place[0, :, 0].to(table.device), place[0, :, 1].to(table.device)]
            costs.append(cost[0][(label >= 0).to(cost.device)])
            labels.append(label[label >= 0])
        if not any(len(cost) for cost in costs):  # the masks leave none of them
            everywhere = _Everywhere(self.space, tuple(ssd_search(z) for z in self.exemplars))
            return everywhere(template, zone)
        return torch.cat(costs), torch.cat(labels)
