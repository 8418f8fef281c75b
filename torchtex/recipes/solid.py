"""Solid textures from pictures: a volume whose slices look like the exemplars, and that tiles."""

import time
from collections.abc import Callable, Sequence

from torchtex.features import Feature, Pixels
from torchtex.recipes.solid_parts import (
    SolidExemplars,
    SolidMaps,
    SolidMasks,
    check_solid,
    sides_of,
)
from torchtex.recipes.solid_plan import Solving, fitting_levels, settings_of
from torchtex.recipes.solid_result import Solid, SolidCheckpoint, SolidStep
from torchtex.recipes.solid_run import Run
from torchtex.schedule import Level


def solid_schedule(steps: int | None = None) -> tuple[Level, ...]:
    """1/4, 1/2 and full scale, windows of 8, then of 6; `steps` replaces the steps of each.

    Windows are staggered from slice to slice and moved in every step. Most steps are made where
    they cost least, at the coarse scales: there the structure is laid out. The last windows are
    smaller than those of the paper, and make slices sharper.

    Source: Kopf et al. 2007, section 3.4.

    Example:
        >>> [(level.scale, level.size) for level in solid_schedule()]
        [(0.25, 8), (0.5, 8), (1.0, 8), (1.0, 6)]
    """
    plan = ((0.25, 8, 30, 1), (0.5, 8, 20, 2), (1.0, 8, 6, 4), (1.0, 6, 8, 2))
    return tuple(Level(scale, size, steps or own, stride) for scale, size, own, stride in plan)


def solid(
    exemplars: SolidExemplars,
    size: tuple[int, int, int],
    *,
    maps: SolidMaps = None,
    map_weight: float = 1.0,
    masks: SolidMasks = None,
    feature: Feature | None = None,
    r: float = 0.8,
    completeness: float = 50.0,
    histogram: float = 5.0,
    schedule: Sequence[Level] | None = None,
    seed: int = 0,
    on_step: Callable[[SolidStep], None] | None = None,
    on_level: Callable[[SolidCheckpoint], None] | None = None,
    resume: SolidCheckpoint | None = None,
) -> Solid:
    """Makes a volume whose slices across all three axes look like the exemplars.

    The slices of the three directions are three texture energies of one volume. Each voxel is in
    the end one exemplar pixel. The volume tiles in all directions.

    Args:
        exemplars: one image (c, hz, wz) for all axes; two, the first for both side views (across
            the depth and across the columns) and the second for the view from above (across the
            rows); or three, across the depth, the rows and the columns, with None where nothing
            is prescribed. The rows of an exemplar lie along the rows of the volume in side
            views, and along its depth in the view from above.
        size: depth, rows and columns of the volume, each at least 6.
        maps: (k, hz, wz) for each exemplar, further channels that are compared, such as the
            distance to the nearest edge; in the same order as the exemplars.
        map_weight: of the maps beside the colours.
        masks: True where an exemplar may be used, in the same order; None for all of one.
        feature: what is compared, such as `Wavelets()`; pixels unless given. Voxels are averages
            and pixels of the exemplars whatever it is.
        r: robust exponent, in (0, 2]; 2 is least squares.
        completeness: how strongly exemplar neighborhoods that nobody uses are preferred; 0 for
            plain nearest neighborhoods, as in the paper.
        histogram: how strongly values that are too frequent lose weight; 0: not at all.
        schedule: levels; `solid_schedule()` unless given. Those that do not fit are left out.
        seed: same seed, same machine: same bits.
        on_step: called after each half-step; raise from it to cancel.
        on_level: called after each level with all that a later run needs to go on from there.
        resume: what `on_level` was given by a run of the same options.

    Raises:
        ValueError: an option out of range, or nothing fits; the message says what to change.

    Source: Kopf et al. 2007; voxels as exemplar pixels after Chen and Wang 2010.

    Example:
        >>> grey = torch.rand(1, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> block = solid(grey, (8, 10, 12), schedule=solid_schedule(1))
        >>> block.volume.shape, torch.equal(block.apply(grey), block.volume)
        (torch.Size([1, 8, 10, 12]), True)
    """
    sides = sides_of(exemplars, maps, masks)
    solving = Solving(r, completeness, histogram, map_weight, feature or Pixels())
    levels = fitting_levels(sides, size, schedule or solid_schedule())
    check_solid(size, len(sides.images[0]), levels[-1].size, seed)
    run = Run(sides, size, levels, solving, seed, settings_of("kopf", sides, size, levels, solving))
    began = time.perf_counter()
    state = run.solve(on_step, on_level, resume)
    earlier = 0.0 if resume is None else sum(trace.seconds for trace in resume.traces)
    return run.finished(state, time.perf_counter() - began + earlier)
