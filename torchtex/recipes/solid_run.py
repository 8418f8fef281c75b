"""A solid being made: levels from coarse to fine, each some half-steps in three directions."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.recipes.slice_models import SliceModel, slice_model
from torchtex.recipes.slice_votes import Fields, averaged, match, prices_of, snapped
from torchtex.recipes.solid_parts import Sides
from torchtex.recipes.solid_places import finer_places, places_of, shapes_of
from torchtex.recipes.solid_plan import Scaled, Solving, scaled
from torchtex.recipes.solid_result import Solid, SolidCheckpoint, SolidStep, SolidTrace
from torchtex.schedule import Level
from torchtex.volumes.slices import Group, groups

SNAPPED = 1
"""Last steps of a level, after which every voxel becomes an exemplar pixel; earlier it would hold
on to the direction that it came from."""

DIMENSIONS = 48
"""Principal axes of neighborhoods that are compared."""

THOROUGH = 3
"""At full scale one step in so many searches all neighborhoods, the others those proposed."""

INHERITED = 0.05
"""Share of the completeness at full scale, which keeps what the coarse scales chose: more of it
makes slices noisy, none of it makes them dull."""


@dataclass(frozen=True)
class Run:
    """One solid to be made: what is given, and what is asked for.

    Args:
        coarse: the exemplars are a coarse band, which has no full scale.
    """

    sides: Sides
    size: tuple[int, int, int]
    levels: Sequence[Level]
    solving: Solving
    seed: int
    settings: dict[str, Any]
    coarse: bool = False

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

    def scaled(self, level: Level) -> Scaled:
        """The exemplars at the scale of a level."""
        return scaled(self.sides, level, self.solving.map_weight)

    def _start(self, number: int, state: SolidCheckpoint, generator: torch.Generator) -> Tensor:
        """First voxels of a level: at random, or the places of the last level in the finer one."""
        level = self.levels[number]
        here = self.scaled(level)
        extent = tuple(max(level.size, level.extent(n)) for n in self.size)
        if state.pixel is None or state.axis is None:
            first = next(n for n in self.sides.axes if n is not None)
            from_ = sum(z[0].numel() for z in here.pictures[:first])
            many = here.pictures[first][0].numel()
            choice = torch.arange(from_, from_ + many)
            if here.used is not None:
                choice = choice[here.used[from_ : from_ + many]]
            pick = choice[torch.randint(len(choice), extent, generator=generator)]
            return here.table[pick.to(here.table.device)]
        before = self.levels[number - 1]
        coarse = [(before.extent(h), before.extent(w)) for h, w in self.sides.shapes]
        fine = shapes_of(here.pictures)
        return here.table[finer_places(state.pixel, state.axis, coarse, fine, extent, generator)]

    def solve_level(
        self,
        number: int,
        volume: Float[Tensor, "d h w k"],
        state: SolidCheckpoint,
        generator: torch.Generator,
        on_step: Callable[[SolidStep], None] | None,
        fields: Fields | None = None,
    ) -> SolidCheckpoint:
        """The steps of one level.

        Args:
            fields: pixels that voxels have in the slices across each axis, if that is known; the
                first step searches no others then.
        """
        began = time.perf_counter()
        level, solving = self.levels[number], self.solving
        here = self.scaled(level)
        models = self.models(here, level, generator)
        full = level.scale == 1 and not self.coarse
        completeness = solving.completeness * (INHERITED if full else 1.0)
        extent, prices, share, pixel, axis = volume.shape[:3], None, None, None, None
        energies, count = [], 0
        for step in range(level.steps):
            pairs = self.windows(level, models, extent, generator)
            if fields is None or (prices is not None and step % THOROUGH == 0):
                prices, fields = prices_of(volume, pairs, completeness), None
            elif prices is None:
                prices = prices_of(volume, pairs, 0.0)
            matches, energy, count = match(volume, pairs, prices, fields, r=solving.r)
            energies.append(energy / count)
            self._tell(on_step, number, step + 0.5, energies[-1], volume)
            share = here.share(volume, solving.histogram, share)
            volume = averaged(matches, here.table, share, extent)
            last = step >= level.steps - SNAPPED
            if full or last:
                pixel, axis, fields = snapped(matches, here.table, volume, here.weights)
            if last and pixel is not None:
                volume = here.table[pixel]
            self._tell(on_step, number, step + 1.0, energies[-1], volume)
        trace = SolidTrace(level, tuple(energies), count, time.perf_counter() - began)
        return SolidCheckpoint(
            self.seed, self.settings, generator.get_state(), (*state.traces, trace), pixel, axis
        )

    def windows(
        self,
        level: Level,
        models: Sequence[SliceModel],
        extent: Sequence[int],
        generator: torch.Generator,
    ) -> list[tuple[SliceModel, Group]]:
        """Windows on all slices of a volume, at places drawn anew, and whom they follow."""
        whole = (extent[0], extent[1], extent[2])
        shift = torch.randint(level.size, (2,), generator=generator)
        stride = level.stride or max(1, level.size // 4)
        return [
            (models[which], group)
            for axis, which in enumerate(self.sides.axes)
            if which is not None
            for group in groups(whole, axis, level.size, stride, shift)
        ]

    def models(self, here: Scaled, level: Level, generator: torch.Generator) -> list[SliceModel]:
        """A model of each exemplar."""
        found, first = [], 0
        fit = (level.size, here.weights, self.solving.feature, DIMENSIONS, generator)
        for picture, mask in zip(here.pictures, here.masks, strict=True):
            found.append(slice_model(picture, mask, first, *fit))
            first += picture[0].numel()
        return found

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
