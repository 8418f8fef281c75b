"""Solid textures from pictures: a volume whose slices look like the exemplars, and that tiles."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.image import resize
from torchtex.inputs import check_not_negative
from torchtex.recipes.slice_models import SliceModel, averaged, match, slice_model, snapped
from torchtex.recipes.solid_parts import (
    Sides,
    SolidExemplars,
    SolidMaps,
    check_solid,
    digest,
    sides_of,
)
from torchtex.recipes.solid_places import finer_places, places_of, shapes_of, table_of
from torchtex.recipes.solid_result import Solid, SolidCheckpoint, SolidStep, SolidTrace
from torchtex.schedule import Level
from torchtex.volumes.slices import Group, groups

SNAPPED = 1
"""Last steps of a level, after which every voxel becomes an exemplar pixel; earlier it would hold
on to the direction that it came from."""

DIMENSIONS = 48
"""Principal axes of neighborhoods that are compared."""


def solid_schedule(steps: int | None = None) -> tuple[Level, ...]:
    """1/4, 1/2 and full scale, windows of 8; `steps` replaces the steps of each.

    Windows lie 2 apart at the coarse scales and 4 at full scale, where they are staggered from
    slice to slice and moved in every step.

    Source: Kopf et al. 2007, section 3.4.

    Example:
        >>> [level.scale for level in solid_schedule()]
        [0.25, 0.5, 1.0]
    """
    plan = ((0.25, 10, 2), (0.5, 8, 2), (1.0, 6, 4))
    return tuple(Level(scale, 8, steps or own, stride) for scale, own, stride in plan)


@dataclass(frozen=True)
class Solving:
    """How a level is solved.

    Args:
        r: robust exponent, in (0, 2].
        completeness: how strongly exemplar neighborhoods that nobody uses are preferred.
        histogram: how strongly values that are too frequent lose weight.
        map_weight: of the maps beside the colours.
    """

    r: float = 0.8
    completeness: float = 50.0
    histogram: float = 5.0
    map_weight: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.r <= 2:
            raise ValueError(f"r={self.r} must lie in (0, 2]")
        for name in ("completeness", "histogram", "map_weight"):
            check_not_negative(name, getattr(self, name))


def solid(
    exemplars: SolidExemplars,
    size: tuple[int, int, int],
    *,
    maps: SolidMaps = None,
    map_weight: float = 1.0,
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
        size: depth, rows and columns of the volume, each at least 8.
        maps: (k, hz, wz) for each exemplar, further channels that are compared, such as the
            distance to the nearest edge; in the same order as the exemplars.
        map_weight: of the maps beside the colours.
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
    sides = sides_of(exemplars, maps)
    solving = Solving(r, completeness, histogram, map_weight)
    levels = fitting_levels(sides, size, schedule or solid_schedule())
    check_solid(size, len(sides.images[0]), levels[-1].size, seed)
    run = Run(sides, size, levels, solving, seed, settings_of("kopf", sides, size, levels, solving))
    began = time.perf_counter()
    state = run.solve(on_step, on_level, resume)
    earlier = 0.0 if resume is None else sum(trace.seconds for trace in resume.traces)
    return run.finished(state, time.perf_counter() - began + earlier)


def settings_of(
    method: str, sides: Sides, size: Sequence[int], levels: Sequence[Level], solving: Solving
) -> dict[str, Any]:
    """Plain values that describe a run."""
    return {
        "method": method,
        "size": list(size),
        "exemplars": [digest(z) for z in sides.exemplars],
        "maps": [digest(m) for m in sides.maps],
        "axes": list(sides.axes),
        **asdict(solving),
        "schedule": [asdict(level) for level in levels],
    }


def fitting_levels(sides: Sides, size: Sequence[int], plan: Sequence[Level]) -> list[Level]:
    """The levels whose windows fit into the volume and have some choice in every exemplar.

    Raises:
        ValueError: the last one is not of full scale, or does not fit the exemplars.
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
    return [
        level
        for level in plan
        if level.extent(min(size)) >= level.size and level.extent(least) >= 2 * level.size
    ] or [plan[-1]]


@dataclass(frozen=True)
class Run:
    """One solid to be made: what is given, and what is asked for."""

    sides: Sides
    size: tuple[int, int, int]
    levels: Sequence[Level]
    solving: Solving
    seed: int
    settings: dict[str, Any]

    def solve(
        self,
        on_step: Callable[[SolidStep], None] | None = None,
        on_level: Callable[[SolidCheckpoint], None] | None = None,
        resume: SolidCheckpoint | None = None,
    ) -> SolidCheckpoint:
        """All levels, coarse to fine; what the last one leaves."""
        generator = torch.Generator().manual_seed(self.seed)
        state = SolidCheckpoint(self.seed, self.settings, generator.get_state())
        if resume is not None:
            state = resume.checked(self.seed, self.settings)
            generator.set_state(state.randomness)
        for number in range(len(state.traces), len(self.levels)):
            start = self._start(number, state, generator)
            state = self.solve_level(number, start, state, generator, on_step)
            if on_level is not None:
                on_level(state)
        return state

    def finished(self, state: SolidCheckpoint, seconds: float) -> Solid:
        """The result of a run of which all levels are done."""
        assert state.pixel is not None
        sources = places_of(state.pixel, self.sides.shapes)
        bare = Solid(
            state.pixel[None].to(self.sides.exemplars[0]), sources, self.sides.shapes,
            state.traces, seconds, self.seed, self.settings,
        )  # fmt: skip
        return replace(bare, volume=bare.apply(self.sides.exemplars).clamp_(0, 1))

    def images(self, level: Level) -> list[Tensor]:
        """Exemplars with their maps at the scale of a level."""
        return [
            z
            if level.scale == 1
            else resize(z, (level.extent(z.shape[1]), level.extent(z.shape[2])))
            for z in self.sides.images
        ]

    def _start(self, number: int, state: SolidCheckpoint, generator: torch.Generator) -> Tensor:
        """First voxels of a level: at random, or the places of the last level in the finer one."""
        level = self.levels[number]
        pictures = self.images(level)
        extent = tuple(max(level.size, level.extent(n)) for n in self.size)
        table = table_of(pictures)
        if state.pixel is None or state.axis is None:
            first = next(n for n in self.sides.axes if n is not None)
            from_ = sum(z[0].numel() for z in pictures[:first])
            pick = torch.randint(pictures[first][0].numel(), extent, generator=generator)
            return table[(pick + from_).to(table.device)]
        coarse = shapes_of(self.images(self.levels[number - 1]))
        fine = shapes_of(pictures)
        return table[finer_places(state.pixel, state.axis, coarse, fine, extent, generator)]

    def solve_level(
        self,
        number: int,
        volume: Float[Tensor, "d h w k"],
        state: SolidCheckpoint,
        generator: torch.Generator,
        on_step: Callable[[SolidStep], None] | None,
    ) -> SolidCheckpoint:
        """The steps of one level."""
        began = time.perf_counter()
        level = self.levels[number]
        models, table, weights = self.models(level, generator)
        energies, count, pixel, axis = [], 0, None, None
        for step in range(level.steps):
            pairs = self.windows(level, models, volume.shape, generator)
            matches, energy, count = match(
                volume, pairs, completeness=self.solving.completeness, r=self.solving.r
            )
            energies.append(energy / count)
            self._tell(on_step, number, step + 0.5, energies[-1], volume)
            mean = averaged(matches, table, volume, self.solving.histogram)
            pixel, axis = snapped(matches, table, mean, weights)
            volume = table[pixel] if step >= level.steps - SNAPPED else mean
            self._tell(on_step, number, step + 1.0, energies[-1], volume)
        trace = SolidTrace(level, tuple(energies), count, time.perf_counter() - began)
        return SolidCheckpoint(
            self.seed, self.settings, generator.get_state(), (*state.traces, trace), pixel, axis
        )

    def windows(
        self,
        level: Level,
        models: Sequence[SliceModel],
        shape: Sequence[int],
        generator: torch.Generator,
    ) -> list[tuple[SliceModel, Group]]:
        """Windows on all slices of a volume, at places drawn anew, and whom they follow."""
        extent = (shape[0], shape[1], shape[2])
        shift = torch.randint(level.size, (2,), generator=generator)
        stride = level.stride or max(1, level.size // 4)
        return [
            (models[which], group)
            for axis, which in enumerate(self.sides.axes)
            if which is not None
            for group in groups(extent, axis, level.size, stride, shift)
        ]

    def models(
        self, level: Level, generator: torch.Generator
    ) -> tuple[list[SliceModel], Float[Tensor, "t k"], Float[Tensor, "k"]]:
        """A model of each exemplar, the pixels of all of them, and weights of the channels."""
        pictures = self.images(level)
        weights = torch.ones(len(pictures[0])).to(pictures[0])
        weights[self.sides.channels :] = self.solving.map_weight
        models, first = [], 0
        for picture in pictures:
            models.append(slice_model(picture, first, level.size, weights, DIMENSIONS, generator))
            first += picture[0].numel()
        return models, table_of(pictures), weights

    def _tell(
        self,
        on_step: Callable[[SolidStep], None] | None,
        number: int,
        steps: float,
        energy: float,
        volume: Tensor,
    ) -> None:
        if on_step is None:
            return
        work = [level.steps * level.scale**4 / (level.stride or 2) for level in self.levels]
        level = self.levels[number]
        done = (sum(work[:number]) + steps / level.steps * work[number]) / sum(work)
        note = f"level {number + 1} of {len(self.levels)}: scale {level.scale:g}"
        preview = volume[..., : self.sides.channels].permute(3, 0, 1, 2)
        on_step(SolidStep(done, note, f"energy {energy:.4g}", preview))
