"""Levels: scales and window sizes, and which of them fit."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from torchtex.image import resize
from torchtex.label_spaces import label_space
from torchtex.neighborhoods import Grid

COMPLETE_SCALE = 0.5
"""Levels up to this scale are complete; finer ones inherit what they chose."""

COMPLETE_PAIRS = 2**26
"""Levels with more pairs of window and exemplar neighborhood than this are not complete."""


@dataclass(frozen=True)
class Level:
    """One entry of a schedule.

    Args:
        scale: of the images, in (0, 1].
        size: width of the windows in pixels of that scale.
        steps: most EM iterations.
        stride: pixels between sites; a quarter of `size` unless given.
        complete: whether neighborhoods that nobody uses are preferred (see `completeness` of
            `synthesize`); None for the coarse levels whose distance matrix is small.
    """

    scale: float
    size: int
    steps: int
    stride: int | None = None
    complete: bool | None = None

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1:
            raise ValueError(f"scale={self.scale} of a level must lie in (0, 1]")
        if self.size < 2:
            raise ValueError(f"size={self.size} of a level's windows must be at least 2")
        if self.steps < 1:
            raise ValueError(f"steps={self.steps} of a level must be at least 1")

    def extent(self, whole: int) -> int:
        """Pixels of this level along an axis of `whole` pixels."""
        return max(1, round(whole * self.scale))

    def grid(self, height: int, width: int, periodic: bool) -> Grid:
        """Sites of this level on a texture of the given full size."""
        stride = self.stride or max(1, self.size // 4)
        return Grid(self.extent(height), self.extent(width), self.size, stride, periodic)


def default_schedule(steps: int | None = None) -> tuple[Level, ...]:
    """1/4 with 12, 8; 1/2 with 16, 8; full with 32, 16, 8; `steps` replaces the steps of each.

    The first level is not in the paper: a window that sees a third of a small exemplar lays out
    weaves and pavings that smaller ones break.

    Source: Kwatra et al. 2005, section 3.2.

    Example:
        >>> [level.size for level in default_schedule()]
        [12, 8, 16, 8, 32, 16, 8]
    """
    quarter = ((0.25, 12, 3), (0.25, 8, 8))
    plan = (*quarter, (0.5, 16, 4), (0.5, 8, 4), (1.0, 32, 2), (1.0, 16, 2), (1.0, 8, 3))
    return tuple(Level(scale, size, steps or own) for scale, size, own in plan)


def planned(
    zs: Sequence[Tensor],
    masks: Sequence[Tensor | None],
    height: int,
    width: int,
    schedule: tuple[Level, ...],
) -> list[Level]:
    """The levels whose windows fit the texture and at least one exemplar with its mask."""
    if schedule[-1].scale != 1:
        raise ValueError(f"schedule ends with scale={schedule[-1].scale:g}; its last must be 1")
    plan = []
    for level in schedule:
        shapes = [(level.extent(z.shape[1]), level.extent(z.shape[2])) for z in zs]
        small = min(level.extent(height), level.extent(width))
        some = [scaled_mask(mask, level) for mask in masks]
        if small >= level.size and len(label_space(shapes, level.size, some)):
            plan.append(level)
    if not plan or plan[-1].scale != 1:
        least = min(level.size for level in schedule if level.scale == 1)
        shapes_ = ", ".join(f"{z.shape[1]}x{z.shape[2]}" for z in zs)
        raise ValueError(
            f"exemplar of {shapes_} for size={height}x{width}: no window of the schedule fits "
            f"at scale=1 (the smallest needs {least} unmasked pixels a side); "
            "give a larger exemplar, size or mask, or a schedule with smaller windows"
        )
    return plan


def roomy(plan: list[Level], exemplars: Sequence[Tensor]) -> list[Level]:
    """Levels whose windows are at most half an exemplar: larger ones have few labels to choose."""
    shortest = max(min(z.shape[1:]) for z in exemplars)
    return [level for level in plan if 2 * level.size <= level.extent(shortest)] or plan[-1:]


def is_complete(level: Level, grid: Grid, exemplars: Sequence[Tensor]) -> bool:
    """Whether a level says so, or is coarse and its full distance matrix small."""
    if level.complete is not None:
        return level.complete
    keys = sum(
        max(0, z.shape[1] - level.size + 1) * max(0, z.shape[2] - level.size + 1) for z in exemplars
    )
    return level.scale <= COMPLETE_SCALE and len(grid) * keys <= COMPLETE_PAIRS


def scaled(z: Tensor, level: Level) -> Tensor:
    """An image at the size of a level."""
    if level.scale == 1:
        return z
    return resize(z, (level.extent(z.shape[1]), level.extent(z.shape[2])))


def scaled_mask(mask: Tensor | None, level: Level) -> Tensor | None:
    """A mask at the size of a level: True where hardly anything is masked out."""
    if mask is None or level.scale == 1:
        return mask
    size = (level.extent(mask.shape[0]), level.extent(mask.shape[1]))
    return resize(mask[None].float(), size)[0] > 0.95
