"""Which elements go, and where new ones are put so that they touch nothing."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from torchtex.layers.elements import Elements, bounded
from torchtex.patches import box_sums, summed_area
from torchtex.recipes.strokes import Stroke, distance

_TRIES = (0, 0, 1, 1, 2, 2)  # anywhere; close to each other; and close to the border too
_NEAR = 3  # pixels
_FREE = 0.9  # of an element's border that lies on the ground, or others may hide part of it


@dataclass(frozen=True)
class Plant:
    """A copy of an element, and where it goes.

    Args:
        number: of the element.
        quarters: that it is turned by, counter-clockwise, after it is mirrored.
        mirror: left and right are exchanged.
        corner: row and column of the first pixel of its box.

    Example:
        >>> found = Elements(torch.tensor([[0, 1, 1], [0, 0, 1]]))
        >>> Plant(1, 1, False, (0, 0)).shape(found).int().tolist()
        [[1, 1], [1, 0]]
    """

    number: int
    quarters: int
    mirror: bool
    corner: tuple[int, int]

    def shape(self, elements: Elements) -> Bool[Tensor, "y x"]:
        """Its pixels, turned, in its own box."""
        mask = elements.mask(self.number)[elements.box(self.number)]
        return torch.rot90(mask.flip(1) if self.mirror else mask, self.quarters)

    def stroke(self, elements: Elements) -> Stroke:
        """The same for `edit`, which turns it about the middle of its box."""
        rows, cols = elements.box(self.number)
        middle = ((rows.start + rows.stop - 1) // 2, (cols.start + cols.stop - 1) // 2)
        angle = self.quarters * math.pi / 2
        cos, sin, side = round(math.cos(angle)), round(math.sin(angle)), 1 - 2 * self.mirror
        ends = []
        for row in (rows.start - middle[0], rows.stop - 1 - middle[0]):
            for col in (cols.start - middle[1], cols.stop - 1 - middle[1]):
                ends.append((cos * row - sin * side * col, sin * row + cos * side * col))
        low = (min(end[0] for end in ends) + middle[0], min(end[1] for end in ends) + middle[1])
        offset = (self.corner[0] - low[0], self.corner[1] - low[1])
        return Stroke(
            elements.mask(self.number), offset, rotation=90.0 * self.quarters, mirror=self.mirror
        )


def thinned(elements: Elements, factor: Tensor, generator: torch.Generator) -> list[int]:
    """Elements that go: each stays with the probability of its factor, and their number is exact.

    Places along a line as long as all probabilities, in random order, one every unit.

    Args:
        factor: how many times as many there are to be, for every pixel.

    Example:
        >>> found = Elements(torch.tensor([[1, 0, 2]]))
        >>> thinned(found, torch.tensor([[0.0, 1.0, 1.0]]).double(), torch.Generator())
        [1]
    """
    count = elements.count
    sums = torch.zeros(count + 1, dtype=torch.float64)
    sums.index_add_(0, elements.labels.flatten().cpu(), factor.flatten())
    stays = (sums[1:] / elements.areas).clamp(max=1)
    order = torch.randperm(count, generator=generator)
    total = stays[order].cumsum(0)
    start = 0.5 + 1e-9 if count else 0.0  # rounds their number
    marks = torch.floor(total + start)
    kept = marks > torch.cat([torch.full((1,), math.floor(start)).double(), marks[:-1]])
    return sorted((order[~kept] + 1).tolist())


def planted(
    elements: Elements,
    stays: Tensor,
    more: Tensor,
    gap: int,
    turn: bool,
    generator: torch.Generator,
) -> list[Plant]:
    """New elements, at places where they touch nothing.

    Args:
        stays: labels of what is there already, of the picture's size.
        more: of new elements to those that `elements` has in as much room, for every pixel.
        gap: pixels between them, at least.
        turn: turn and mirror them.

    Raises:
        ValueError: not all fit, or there is no whole element to copy.

    Example:
        >>> found = Elements(torch.tensor([[0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]]))
        >>> more = torch.ones(3, 4).double()
        >>> len(planted(found, found.labels, more, 1, False, torch.Generator()))
        1
    """
    wanted = round(elements.count * float(more.sum()) / elements.labels.numel())
    if not wanted:
        return []
    models = _models(elements)
    if not models:
        raise ValueError(
            "elements: all are cut off by the edge of the picture, and no whole one can be added; "
            "give a larger picture"
        )
    there = int(len(stays.unique()) - bool((stays == 0).any()))
    taken = distance(stays > 0, gap) <= gap if there else torch.zeros_like(stays > 0)
    most = 0
    for snug in _TRIES:
        plants = _try(elements, models, taken, more, wanted, (gap, turn, snug), generator)
        if len(plants) == wanted:
            return plants
        most = max(most, len(plants))
    raise ValueError(
        f"amount: {most} of {wanted} new elements fit, {there + most} in all, before the picture "
        "is full; ask for less, or for a smaller gap"
    )


def _models(elements: Elements) -> list[int]:
    """Whole elements; those that lie free on the ground, if there are any."""
    whole = elements.whole()
    free = torch.from_numpy(bounded(elements.labels.cpu().numpy())) >= _FREE
    alone = whole[free[whole - 1]]
    return (alone if len(alone) else whole).tolist()


def _try(
    elements: Elements,
    models: list[int],
    taken: Tensor,
    more: Tensor,
    wanted: int,
    how: tuple[int, bool, int],
    generator: torch.Generator,
) -> list[Plant]:
    """As many of them as fit, one after the other."""
    gap, turn, snug = how
    plants: list[Plant] = []
    taken = taken.clone()
    while len(plants) < wanted:
        new = None
        for index in torch.randperm(len(models), generator=generator).tolist():
            pose = int(torch.randint(8, (), generator=generator)) if turn else 0
            new = Plant(models[index], pose % 4, pose >= 4, (0, 0))
            new = _placed(new, new.shape(elements), taken, more, snug, generator)
            if new is not None:
                break
        if new is None:
            break
        plants.append(new)
        shape = new.shape(elements)
        own = torch.zeros_like(taken)
        i, j = new.corner
        own[i : i + shape.shape[0], j : j + shape.shape[1]] = shape
        taken |= distance(own, gap) <= gap
    return plants


def _placed(
    plant: Plant,
    shape: Tensor,
    taken: Tensor,
    weight: Tensor,
    snug: int,
    generator: torch.Generator,
) -> Plant | None:
    """The plant somewhere where there is room and weight, beside others if snug; or None."""
    (y, x), (h, w) = shape.shape, taken.shape
    if y > h or x > w:
        return None
    means = box_sums(summed_area(weight), y, x).clamp(min=0) / (y * x)
    free = _overlap(taken, shape) < 0.5
    chances = torch.where(free & (means > 1e-9), means, 0)
    if not bool((chances > 0).any()):
        return None
    if snug:
        near = torch.nn.functional.pad(taken, [_NEAR] * 4, value=snug > 1)
        touch = _overlap(distance(near, _NEAR) <= _NEAR, shape)[_NEAR:, _NEAR:]
        touch = torch.where(chances > 0, touch[: h - y + 1, : w - x + 1], -1.0)
        chances = chances * (touch > touch.max() - 1.5)
    total = chances.flatten().cumsum(0)
    draw = torch.rand((), generator=generator, dtype=torch.float64) * total[-1]
    found = min(int(torch.searchsorted(total, draw, right=True)), len(total) - 1)
    return Plant(plant.number, plant.quarters, plant.mirror, divmod(found, w - x + 1))


def _overlap(taken: Tensor, shape: Tensor) -> Tensor:
    """Pixels of a shape that are taken, for every place of its first pixel."""
    (y, x), (h, w) = shape.shape, taken.shape
    size = (h + y, w + x)
    spectrum = torch.fft.rfft2(shape.double(), s=size).conj()
    hits = torch.fft.irfft2(torch.fft.rfft2(taken.double(), s=size) * spectrum, s=size)
    return hits[: h - y + 1, : w - x + 1].round()
