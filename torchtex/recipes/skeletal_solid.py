"""Skeletal solids: a coarse solid first, then the detail of its exemplars in three directions."""

import time
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.features import Feature, Pixels
from torchtex.recipes.slice_votes import Fields, match, prices_of, snapped
from torchtex.recipes.solid_parts import (
    Sides,
    SolidExemplars,
    SolidMaps,
    SolidMasks,
    check_solid,
    sides_of,
)
from torchtex.recipes.solid_places import coarse_mask, finer_places, shapes_of
from torchtex.recipes.solid_plan import Solving, fitting_levels, settings_of
from torchtex.recipes.solid_result import Solid, SolidCheckpoint, SolidStep
from torchtex.recipes.solid_run import Run
from torchtex.schedule import Level
from torchtex.wavelets import decompose

COARSE = (Level(0.5, 8, 20, 1), Level(1.0, 8, 10, 2))
"""Levels of the coarse solid, by its own scale."""

FINE = (6, 2)
"""Size of the windows and their stride in the refinement."""


def skeletal_solid(
    exemplars: SolidExemplars,
    size: tuple[int, int, int],
    *,
    octaves: int = 1,
    refine: int = 2,
    maps: SolidMaps = None,
    map_weight: float = 1.0,
    masks: SolidMasks = None,
    feature: Feature | None = None,
    r: float = 0.8,
    completeness: float = 50.0,
    histogram: float = 5.0,
    seed: int = 0,
    on_step: Callable[[SolidStep], None] | None = None,
    on_level: Callable[[SolidCheckpoint], None] | None = None,
    resume: SolidCheckpoint | None = None,
) -> Solid:
    """As `solid`, but only the coarse Haar band is synthesized; the detail is copied.

    Every coarse voxel has, for each of the three directions, a place in the coarse exemplar. The
    Haar detail that belongs to that place makes slices of full size, each used for as many fine
    voxels as a coarse one is thick, and a voxel is the mean over the directions.

    Of an exemplar the last rows and columns that fill no coarse pixel are left out; the settings
    say how many (`unused`). A size that 2^octaves does not divide is made exactly.

    Args:
        octaves: of the decomposition, 1 to 3: the coarse solid is 2, 4 or 8 times smaller.
        refine: steps of `solid` at full scale on that mean, which is duller than the exemplar;
            0 leaves it as it is, as the paper does, and voxels are then no exemplar pixels.

    The other options are those of `solid`.

    Raises:
        ValueError: an option out of range, or nothing fits; the message says what to change.

    Source: Pan et al. 2009, section 3, for solids; the refinement is not in the paper.

    Example:
        >>> grey = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> skeletal_solid(grey, (16, 16, 16)).volume.shape
        torch.Size([1, 16, 16, 16])
    """
    began = time.perf_counter()
    if octaves not in (1, 2, 3):
        raise ValueError(f"octaves={octaves} must be 1, 2 or 3")
    if refine < 0:
        raise ValueError(f"refine={refine} must be at least 0")
    sides = sides_of(exemplars, maps, masks)
    solving = Solving(r, completeness, histogram, map_weight, feature or Pixels())
    factor = 2**octaves
    fine_sides, coarse_sides = _trimmed(sides, factor), _band(_trimmed(sides, factor), octaves)
    small = (-(-size[0] // factor), -(-size[1] // factor), -(-size[2] // factor))
    levels = _coarse_levels(sides, coarse_sides, small, octaves)
    check_solid(size, len(sides.images[0]), levels[-1].size * factor, seed)
    settings = settings_of("skeletal", sides, size, levels, solving)
    unused = [[n % factor for n in shape] for shape in sides.shapes]
    settings |= {"octaves": octaves, "refine": refine, "unused": unused}
    coarse = Run(coarse_sides, small, levels, solving, seed, settings, coarse=True)
    level = Level(1.0, FINE[0], max(1, refine), FINE[1])
    fine = Run(fine_sides, size, [level], solving, seed, settings)
    share = 0.5 if refine else 1.0
    state = coarse.solve(_part(on_step, 0.0, share), on_level, resume)
    generator = torch.Generator()
    generator.set_state(state.randomness)
    mixed, fields = _mixed(coarse, fine, state, generator)
    earlier = 0.0 if resume is None else sum(trace.seconds for trace in resume.traces)
    if refine:
        watch = _part(on_step, share, 1.0)
        state = fine.solve_level(0, mixed, state, generator, watch, fields)
    else:
        first = min(fields)
        state = replace(state, pixel=fields[first], axis=torch.full_like(fields[first], first))
    made = fine.finished(state, time.perf_counter() - began + earlier)
    if not refine:
        mean = mixed[..., : sides.channels].permute(3, 0, 1, 2).contiguous()
        made = replace(made, volume=mean.clamp(0, 1))
    return replace(made, shapes=sides.shapes)


def _trimmed(sides: Sides, factor: int) -> Sides:
    """Exemplars less the last rows and columns that fill no whole coarse pixel."""

    def cut(z: Tensor) -> Tensor:
        return z[:, : z.shape[1] // factor * factor, : z.shape[2] // factor * factor]

    return replace(
        sides, exemplars=tuple(map(cut, sides.exemplars)), maps=tuple(map(cut, sides.maps)),
        masks=tuple(None if m is None else cut(m[None])[0] for m in sides.masks),
    )  # fmt: skip


def _band(sides: Sides, octaves: int) -> Sides:
    """Exemplars of the coarse Haar band, in the range of colours."""

    def coarse(z: Tensor) -> Tensor:
        return decompose(z, "haar", octaves).approximation / 2**octaves

    return replace(
        sides, exemplars=tuple(map(coarse, sides.exemplars)), maps=tuple(map(coarse, sides.maps)),
        masks=tuple(
            None if m is None else coarse_mask(m, m.shape[0] >> octaves, m.shape[1] >> octaves)
            for m in sides.masks
        ),
    )  # fmt: skip


def _coarse_levels(
    sides: Sides, coarse: Sides, small: tuple[int, int, int], octaves: int
) -> list[Level]:
    """Levels that fit the coarse exemplars; errors are told of those given."""
    window = COARSE[-1].size << octaves
    fewer = "choose fewer octaves or" if octaves > 1 else "choose"
    height, width = min(sides.shapes, key=min)
    if min(height, width) < 2 * window:
        raise ValueError(
            f"octaves={octaves} is too many for an exemplar of {height}x{width}, which must be at "
            f"least {2 * window} pixels a side; {fewer} a larger exemplar"
        )
    try:
        return fitting_levels(coarse, small, COARSE)
    except ValueError:
        raise ValueError(
            f"octaves={octaves} is too many for the masks, into one of which no window of {window} "
            f"pixels fits; {fewer} wider masks"
        ) from None


def _part(
    on_step: Callable[[SolidStep], None] | None, start: float, end: float
) -> Callable[[SolidStep], None] | None:
    """Progress of a part of the work."""
    if on_step is None:
        return None
    return lambda step: on_step(replace(step, done=start + (end - start) * step.done))


def _mixed(
    coarse: Run, fine: Run, state: SolidCheckpoint, generator: torch.Generator
) -> tuple[Float[Tensor, "d h w k"], Fields]:
    """The mean over the directions of coarse voxels with the detail of each, and its places."""
    assert state.pixel is not None
    level = coarse.levels[-1]
    small, large = coarse.scaled(level), fine.scaled(fine.levels[0])
    volume = small.table[state.pixel]
    pairs = coarse.windows(
        level, coarse.models(small, level, generator), volume.shape[:3], generator
    )
    matches, _, _ = match(volume, pairs, prices_of(volume, pairs, 0.0), r=coarse.solving.r)
    _, _, said = snapped(matches, small.table, volume, small.weights)
    old, new = shapes_of(small.pictures), shapes_of(large.pictures)
    parents = [
        ((torch.arange(many) + 0.5) * few / many).long().clamp(max=few - 1)
        for many, few in zip(fine.size, volume.shape[:3], strict=True)
    ]
    total, fields = None, {}
    for axis, pixel in said.items():
        fields[axis] = finer_places(pixel, torch.full_like(pixel, axis), old, new, fine.size)
        lacking = (volume - small.table[pixel])[parents[0]][:, parents[1]][:, :, parents[2]]
        slices = large.table[fields[axis]] + lacking  # the coarse voxel, its place's detail
        total = slices if total is None else total + slices
    assert total is not None
    return total / len(said), fields
