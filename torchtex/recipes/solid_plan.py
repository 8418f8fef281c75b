"""What a solid is made by: options, the levels that fit, and the exemplars at their scales."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.features import Feature, Pixels, as_windowed
from torchtex.image import resize
from torchtex.inputs import check_not_negative
from torchtex.label_spaces import label_space
from torchtex.recipes.solid_parts import Sides, digest
from torchtex.recipes.solid_places import coarse_mask, table_of, usable
from torchtex.schedule import Level
from torchtex.volumes.histograms import excess

HELD = 0.8
"""Share of the last step's weights of colours that stays: without, steps swing to and fro."""


@dataclass(frozen=True)
class Solving:
    """How a level is solved.

    Args:
        r: robust exponent, in (0, 2].
        completeness: how strongly exemplar neighborhoods that nobody uses are preferred.
        histogram: how strongly values that are too frequent lose weight.
        map_weight: of the maps beside the colours.
        feature: what is compared.
    """

    r: float = 0.8
    completeness: float = 50.0
    histogram: float = 5.0
    map_weight: float = 1.0
    feature: Feature = Pixels()  # noqa: RUF009 - frozen

    def __post_init__(self) -> None:
        if not 0 < self.r <= 2:
            raise ValueError(f"r={self.r} must lie in (0, 2]")
        for name in ("completeness", "histogram", "map_weight"):
            check_not_negative(name, getattr(self, name))
        if as_windowed(self.feature) is not None:
            raise ValueError(
                'feature: Wavelets(mode="window") has a stage inside windows, which slices of a '
                'solid lack; use mode="stationary"'
            )


def settings_of(
    method: str, sides: Sides, size: Sequence[int], levels: Sequence[Level], solving: Solving
) -> dict[str, Any]:
    """Plain values that describe a run."""
    return {
        "method": method,
        "size": list(size),
        "exemplars": [digest(z) for z in sides.exemplars],
        "maps": [digest(m) for m in sides.maps],
        "masks": [None if m is None else digest(m) for m in sides.masks],
        "axes": list(sides.axes),
        "r": solving.r,
        "completeness": solving.completeness,
        "histogram": solving.histogram,
        "map_weight": solving.map_weight,
        "feature": repr(solving.feature),
        "schedule": [asdict(level) for level in levels],
    }


def fitting_levels(sides: Sides, size: Sequence[int], plan: Sequence[Level]) -> list[Level]:
    """The levels whose windows fit into the volume and have some choice in every exemplar.

    Raises:
        ValueError: the last one is not of full scale, or does not fit the exemplars or masks.
    """
    if not plan or plan[-1].scale != 1:
        raise ValueError("schedule must end with a level of scale=1")
    least = min(min(shape) for shape in sides.shapes)
    if least < 2 * plan[-1].size:
        shapes = ", ".join(f"{h}x{w}" for h, w in sides.shapes)
        raise ValueError(
            f"exemplar of {shapes}: windows of {plan[-1].size} have too little choice; give "
            f"pictures of at least {2 * plan[-1].size} pixels a side"
        )
    if _choice(sides, plan[-1]) < 1:
        raise ValueError(
            f"mask: no window of {plan[-1].size} pixels fits into it; widen it, or crop the "
            "exemplar to what may be used"
        )
    return [
        level
        for level in plan
        if level.extent(min(size)) >= level.size
        and level.extent(least) >= 2 * level.size
        and _choice(sides, level) >= level.size
    ] or [plan[-1]]


def _choice(sides: Sides, level: Level) -> int:
    """Windows that the exemplar with the fewest has."""
    found = []
    for (h, w), mask in zip(sides.shapes, sides.masks, strict=True):
        shape = level.extent(h), level.extent(w)
        found.append(len(label_space([shape], level.size, [coarse_mask(mask, *shape)])))
    return min(found)


@dataclass(frozen=True)
class Scaled:
    """Exemplars at the scale of a level.

    Args:
        pictures: with their maps as further channels.
        masks: of each, or None.
        table: pixels of all of them.
        used: those that may be used; None for all.
        weights: of the channels.
    """

    pictures: Sequence[Tensor]
    masks: Sequence[Tensor | None]
    table: Float[Tensor, "t k"]
    used: Bool[Tensor, "t"] | None
    weights: Float[Tensor, "k"]

    def share(
        self, volume: Float[Tensor, "d h w k"], histogram: float, old: Tensor | None
    ) -> Float[Tensor, "t"]:
        """Weights of pixels: less where the volume has more of their values than the table."""
        over = excess(self.table.T, volume.flatten(0, 2).T, used=self.used)
        new = 1 / (1 + histogram * over)
        return new if old is None else old.lerp(new, 1 - HELD)


def scaled(sides: Sides, level: Level, map_weight: float) -> Scaled:
    """The exemplars at the scale of a level."""
    shapes = [(level.extent(h), level.extent(w)) for h, w in sides.shapes]
    pictures, masks = sides.images, list(sides.masks)
    if level.scale != 1:
        pictures = [resize(z, shape) for z, shape in zip(pictures, shapes, strict=True)]
        masks = [coarse_mask(m, *shape) for m, shape in zip(masks, shapes, strict=True)]
    weights = torch.ones(len(pictures[0])).to(pictures[0])
    weights[sides.channels :] = map_weight
    return Scaled(pictures, masks, table_of(pictures), usable(masks, shapes), weights)
