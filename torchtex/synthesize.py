"""Coarse to fine: the whole synthesis, and its result."""

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex import image as images
from torchtex.controls import Guide, Scaled, SoftConstraint
from torchtex.em import Fit, HalfStep, em
from torchtex.energy import Energy
from torchtex.estep import Auto, EStep
from torchtex.features import Feature, Pixels
from torchtex.image import check_image, resize
from torchtex.labels import LabelField
from torchtex.model import (
    Search,
    TextureModel,
    fast_search,
    label_space,
    strips,
    texture_model,
)
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
    """

    scale: float
    size: int
    steps: int
    stride: int | None = None

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


@runtime_checkable
class Start(Protocol):
    """First pixels of the coarsest level."""

    def __call__(
        self,
        exemplars: Sequence[Tensor],
        masks: Sequence[Tensor | None],
        grid: Grid,
        generator: torch.Generator,
    ) -> Float[Tensor, "c h w"]: ...


@dataclass(frozen=True)
class Blocks:
    """Random blocks of the coarse exemplar side by side, not averaged.

    Args:
        fraction: side of a block, of the shortest exemplar side.
    """

    fraction: float = 0.2

    def __post_init__(self) -> None:
        if not 0 < self.fraction <= 1:
            raise ValueError(f"fraction={self.fraction} of blocks must lie in (0, 1]")

    def __call__(
        self,
        exemplars: Sequence[Tensor],
        masks: Sequence[Tensor | None],
        grid: Grid,
        generator: torch.Generator,
    ) -> Float[Tensor, "c h w"]:
        shapes = [(z.shape[1], z.shape[2]) for z in exemplars]
        side = max(2, round(self.fraction * min(min(shape) for shape in shapes)))
        space = label_space(shapes, side, masks)
        while not len(space):  # a mask may leave no room for so large a block
            side = side // 2
            space = label_space(shapes, side, masks)
        ny, nx = -(-grid.height // side), -(-grid.width // side)
        labels = torch.randint(len(space), (ny * nx,), generator=generator)
        blocks = strips(exemplars, space, side).patches(labels.to(exemplars[0].device))
        blocks = blocks.view(ny, nx, side, side, -1).permute(4, 0, 2, 1, 3)
        whole = blocks.reshape(len(exemplars[0]), ny * side, nx * side)
        return whole[:, : grid.height, : grid.width].contiguous()


@dataclass(frozen=True)
class RandomNeighborhoods:
    """A random exemplar neighborhood at every site, averaged.

    Source: Kwatra et al. 2005, Algorithm 1.
    """

    def __call__(
        self,
        exemplars: Sequence[Tensor],
        masks: Sequence[Tensor | None],
        grid: Grid,
        generator: torch.Generator,
    ) -> Float[Tensor, "c h w"]:
        shapes = tuple((z.shape[1], z.shape[2]) for z in exemplars)
        space = label_space(shapes, grid.size, masks)
        pick = torch.randint(len(space), (len(grid),), generator=generator)
        weights = torch.ones(len(grid)).to(exemplars[0])
        return LabelField(grid, space.positions[pick], weights, shapes).apply(exemplars)


@dataclass(frozen=True)
class Progress:
    """What `on_step` is given.

    Args:
        level, levels: number of the level from 0, and how many there are.
        schedule: the level's settings.
        half: the half-step that has just ended; `half.texture` is a preview.
        done: share of the work that is done, in [0, 1], by an estimate.
    """

    level: int
    levels: int
    schedule: Level
    half: HalfStep
    done: float

    @property
    def note(self) -> str:
        """What goes on, in a few words."""
        level = self.schedule
        return (
            f"level {self.level + 1} of {self.levels}: scale {level.scale:g}, window {level.size}"
        )

    @property
    def detail(self) -> str:
        """The energy, as text."""
        return f"energy {self.half.energy:.4g}"

    @property
    def texture(self) -> Float[Tensor, "c h w"]:
        """A preview."""
        return self.half.texture


@dataclass(frozen=True)
class Trace:
    """Record of one level: its settings, the energy after each half-step, seconds, last pixels."""

    level: Level
    energies: tuple[float, ...]
    sites: int
    seconds: float
    snapshot: Float[Tensor, "c _ _"]


@dataclass(frozen=True)
class Result:
    """A texture, where it came from, and how it was made.

    Args:
        texture: (c, h, w) in [0, 1].
        labels: label of each site of the finest grid, in its label space.
        field: positions, weights and grid: renders aligned maps.
        traces: one per level.
        seconds: of the whole synthesis.
        seed: of the run.
        settings: plain values that describe the run.
    """

    texture: Float[Tensor, "c h w"]
    labels: Int[Tensor, "n"]
    field: LabelField
    traces: tuple[Trace, ...]
    seconds: float
    seed: int
    settings: Mapping[str, Any]

    @property
    def offsets(self) -> Int[Tensor, "ny nx 2"]:
        """Offset field; see `LabelField.offsets`."""
        return self.field.offsets

    @property
    def source_map(self) -> Int[Tensor, "h w 3"]:
        """Exemplar, row and column of each pixel; see `LabelField.source_map`."""
        return self.field.source_map()

    @property
    def energies(self) -> tuple[float, ...]:
        """Energy after each half-step, all levels in order, per site."""
        return tuple(e / trace.sites for trace in self.traces for e in trace.energies)

    def apply(
        self, maps: Float[Tensor, "k _ _"] | Sequence[Float[Tensor, "k _ _"]]
    ) -> Float[Tensor, "k h w"]:
        """Renders maps aligned with the exemplars with the same labels and weights."""
        return self.field.apply(maps)

    def save(self, path: str | Path, *, bits: Literal[8, 16] = 8) -> None:
        """Writes the texture; a PNG also holds the settings, as JSON in the text chunk torchtex."""
        images.save(path, self.texture, bits=bits, metadata={"torchtex": json.dumps(self.report())})

    def report(self) -> dict[str, Any]:
        """Settings, seed, timings and energies as plain values."""
        return {
            "seed": self.seed,
            "seconds": self.seconds,
            "settings": dict(self.settings),
            "levels": [
                {
                    **asdict(trace.level),
                    "sites": trace.sites,
                    "seconds": trace.seconds,
                    "energies": list(trace.energies),
                }
                for trace in self.traces
            ],
        }

    def plot(self) -> Any:
        """The energy curve as a matplotlib figure, with the last texture of each level.

        Source: the layout of Kwatra et al. 2005, fig. 3.

        Raises:
            ImportError: matplotlib is missing.
        """
        try:
            from matplotlib.figure import Figure
        except ImportError:
            raise ImportError("result.plot() needs matplotlib; install torchtex[plot]") from None
        figure = Figure(figsize=(2.2 * len(self.traces), 5), layout="constrained")
        grid = figure.add_gridspec(2, len(self.traces), height_ratios=(2, 1))
        curve, start = figure.add_subplot(grid[0, :]), 0
        for number, trace in enumerate(self.traces):
            energies = [e / trace.sites for e in trace.energies]
            name = f"{trace.level.scale:g}, {trace.level.size} px"
            curve.plot(range(start, start + len(energies)), energies, marker=".", label=name)
            start += len(energies)
            axes = figure.add_subplot(grid[1, number])
            axes.imshow(
                trace.snapshot[:3].mean(0).cpu().numpy()
                if len(trace.snapshot) != 3
                else trace.snapshot.clamp(0, 1).permute(1, 2, 0).cpu().numpy(),
                cmap="gray",
            )
            axes.set_title(name)
            axes.set_axis_off()
        curve.set_xlabel("half-step")
        curve.set_ylabel("energy per site")
        curve.legend()
        return figure


def synthesize(
    exemplars: Float[Tensor, "c _ _"] | Sequence[Float[Tensor, "c _ _"]],
    size: tuple[int, int],
    *,
    masks: Bool[Tensor, "_ _"] | Sequence[Bool[Tensor, "_ _"] | None] | None = None,
    feature: Feature | None = None,
    r: float = 0.8,
    completeness: float = 50.0,
    start: Start | None = None,
    init: Float[Tensor, "c _ _"] | None = None,
    schedule: Sequence[Level] | None = None,
    boundary: Literal["free", "periodic"] = "free",
    carry: bool = True,
    search: Search | None = None,
    estep: EStep | None = None,
    controls: Sequence[tuple[float, Energy]] = (),
    guides: Sequence[Guide] = (),
    seed: int = 0,
    on_step: Callable[[Progress], None] | None = None,
) -> Result:
    """Makes a texture of `size` that looks like the exemplars.

    Args:
        exemplars: one image (c, hz, wz) in [0, 1] or several; several are one label space.
        size: height and width of the texture, in pixels.
        masks: True where an exemplar may be used; one per exemplar.
        feature: what is compared; `Pixels()` unless given.
        r: robust exponent, in (0, 2]; 2 is least squares.
        completeness: at the coarse levels, how strongly exemplar neighborhoods that nobody uses
            are preferred; 0 for plain nearest neighborhoods, as in the paper.
        start: first pixels; `Blocks()` unless given.
        init: an image to start from instead; resized to the coarsest level.
        schedule: levels; those whose windows do not fit are left out. `default_schedule()`
            unless given, less the windows larger than half an exemplar.
        boundary: "periodic" makes a texture that tiles.
        carry: begin each level with exemplar pixels picked by the labels of the last, where the
            scale changes and, without controls, at full scale; False keeps or enlarges the
            averaged pixels, as the paper does.
        search: of the M-step; `fast_search()` unless given.
        estep: `Auto()` unless given.
        controls: (weight, energy) pairs; any function of the image is an energy. One with a
            method `at(height, width)` is asked for its form at each level.
        guides: fixed channels to follow.
        seed: same seed, same machine: same bits.
        on_step: called after each half-step; raise from it to cancel.

    Raises:
        ValueError: an option out of range, or nothing fits; the message says what to change.

    Source: Kwatra et al. 2005; completeness after Simakov et al. 2008 and Granot et al. 2022.

    Example:
        >>> from torchtex import data
        >>> synthesize(data.load("gravel")[:, :40, :40], (48, 64), seed=1).texture.shape
        torch.Size([1, 48, 64])
    """
    began = time.perf_counter()
    zs = [exemplars] if isinstance(exemplars, Tensor) else list(exemplars)
    height, width = _check(zs, size, boundary)
    _check_steering(zs, controls, guides)
    if not completeness >= 0:
        raise ValueError(f"completeness={completeness} must be at least 0")
    zs = [z.detach() for z in zs]
    keep = _masks(masks, zs)
    plan = _plan(zs, keep, height, width, tuple(schedule or default_schedule()))
    if schedule is None:
        plan = _roomy(plan, zs)
    if init is not None:
        check_image(init, "init")
        if len(init) != len(zs[0]):
            raise ValueError(
                f"init has {len(init)} channels and exemplar {len(zs[0])}; give both the same"
            )
    feature = Pixels() if feature is None else feature
    search = fast_search() if search is None else search
    estep = Auto() if estep is None else estep
    generator = torch.Generator().manual_seed(seed)
    traces: list[Trace] = []
    work = [level.steps * len(level.grid(height, width, False)) * level.size**2 for level in plan]
    x: Tensor | None = None
    fit: Fit | None = None
    model: TextureModel | None = None
    for number, level in enumerate(plan):
        level_began = time.perf_counter()
        grid = level.grid(height, width, boundary == "periodic")
        smaller = [_scaled(z, level) for z in zs]
        some = [_scaled_mask(mask, level) for mask in keep]
        if x is None:
            if init is None:
                x = (start or Blocks())(smaller, some, grid, generator)
            else:
                x = resize(init.to(zs[0]), (grid.height, grid.width))
        elif tuple(x.shape[1:]) != (grid.height, grid.width):
            assert model is not None
            assert fit is not None
            if carry:
                x = _carried(model, fit, x, smaller, some, grid)
            else:
                x = resize(x, (grid.height, grid.width))
        elif carry and level.scale == 1 and not controls:
            assert model is not None
            assert fit is not None
            x = _composed(model, fit, x, smaller)
        model = texture_model(
            smaller,
            grid,
            feature=feature,
            search=search,
            r=r,
            completeness=completeness if _complete(level, grid, smaller) else 0.0,
            masks=some,
            guides=[g.at(level.scale, grid.height, grid.width) for g in guides],
            generator=generator,
        )
        terms = [
            (w, c.at(grid.height, grid.width) if isinstance(c, Scaled) else c) for w, c in controls
        ]
        report = _reporter(on_step, number, plan, work)
        fit = em(x, [model], terms, estep, steps=level.steps, on_step=report)
        x = fit.texture
        seconds = time.perf_counter() - level_began
        traces.append(Trace(level, fit.energies, len(grid), seconds, x))
    assert x is not None
    assert fit is not None
    assert model is not None
    labels = fit.labels[0]
    field = _field(model, labels, x, zs)
    if isinstance(feature, Pixels) and not controls:
        x = field.apply(zs)  # one more reweighted mean, so that `apply` gives the same bits
    settings = {
        "size": [height, width],
        "feature": repr(feature),
        "r": r,
        "completeness": completeness,
        "start": repr(start or Blocks()) if init is None else "init",
        "boundary": boundary,
        "carry": carry,
        "search": repr(search),
    }
    elapsed = time.perf_counter() - began
    return Result(x.clamp(0, 1), labels, field, tuple(traces), elapsed, seed, settings)


def estimate_memory(shapes: Sequence[tuple[int, int]], size: tuple[int, int], channels: int) -> int:
    """Bytes a synthesis holds at its peak, about: images, keys and one band of windows."""
    texture = size[0] * size[1]
    exemplar = sum(h * w for h, w in shapes)
    band = 16384 * 64
    return 4 * (channels * (14 * texture + 60 * exemplar + 12 * band) + 80 * exemplar)


def _check(zs: Sequence[Tensor], size: tuple[int, int], boundary: str) -> tuple[int, int]:
    if not zs:
        raise ValueError("exemplar: none given; give at least one image")
    for z in zs:
        check_image(z, "exemplar")
        if len(z) != len(zs[0]):
            raise ValueError(
                f"exemplar: one has {len(zs[0])} channels and another {len(z)}; "
                "convert them to the same"
            )
        if z.dtype not in (torch.float32, torch.float64) or z.dtype != zs[0].dtype:
            raise TypeError(
                f"exemplar: {z.dtype} beside {zs[0].dtype}; give all as float32 or all as float64"
            )
    height, width = size
    if height < 1 or width < 1:
        raise ValueError(f"size={height}x{width} must be at least 1x1; give height x width")
    if boundary not in ("free", "periodic"):
        raise ValueError(f'boundary="{boundary}" must be "free" or "periodic"')
    need = estimate_memory([(z.shape[1], z.shape[2]) for z in zs], size, len(zs[0]))
    have = _memory()
    if have is not None and need > have:
        raise ValueError(
            f"size={height}x{width} would need about {need / 2**30:.1f} GiB of memory and "
            f"{have / 2**30:.1f} GiB are there; choose a smaller size"
        )
    return height, width


def _check_steering(
    zs: Sequence[Tensor], controls: Sequence[tuple[float, Energy]], guides: Sequence[Guide]
) -> None:
    for _, control in controls:
        if isinstance(control, SoftConstraint) and len(control.target) != len(zs[0]):
            raise ValueError(
                f"target of a soft constraint has {len(control.target)} channels and exemplar "
                f"{len(zs[0])}; give both the same"
            )
    shapes = [z.shape[1:] for z in zs]
    for guide in guides:
        if [z.shape[1:] for z in guide.exemplars] != shapes:
            given = ", ".join(f"{z.shape[1]}x{z.shape[2]}" for z in guide.exemplars) or "none"
            raise ValueError(
                f"guide of the exemplars: {given} given for exemplars of "
                f"{', '.join(f'{h}x{w}' for h, w in shapes)}; give one each, of the same size"
            )


def _memory() -> int | None:
    """Bytes of physical memory, where the system tells."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None


def _masks(
    masks: Tensor | Sequence[Tensor | None] | None, zs: Sequence[Tensor]
) -> list[Tensor | None]:
    if masks is None:
        return [None] * len(zs)
    keep: list[Tensor | None] = [masks] if isinstance(masks, Tensor) else list(masks)
    if len(keep) != len(zs):
        raise ValueError(f"mask: {len(keep)} given for {len(zs)} exemplars; give one each")
    for mask, z in zip(keep, zs, strict=True):
        if mask is None:
            continue
        if mask.shape != z.shape[1:]:
            raise ValueError(
                f"mask is {mask.shape[0]}x{mask.shape[1]} and its exemplar "
                f"{z.shape[1]}x{z.shape[2]}; give a mask of the size of the exemplar"
            )
        if not bool(mask.any()):
            raise ValueError("mask is empty: no pixel of the exemplar may be used; widen it")
    return keep


def _plan(
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
        some = [_scaled_mask(mask, level) for mask in masks]
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


def _roomy(plan: list[Level], exemplars: Sequence[Tensor]) -> list[Level]:
    """Levels whose windows are at most half an exemplar: larger ones have few labels to choose."""
    shortest = max(min(z.shape[1:]) for z in exemplars)
    return [level for level in plan if 2 * level.size <= level.extent(shortest)] or plan[-1:]


def _complete(level: Level, grid: Grid, exemplars: Sequence[Tensor]) -> bool:
    """Whether the full distance matrix of a level is small enough to be worth it."""
    keys = sum(
        max(0, z.shape[1] - level.size + 1) * max(0, z.shape[2] - level.size + 1) for z in exemplars
    )
    return level.scale <= COMPLETE_SCALE and len(grid) * keys <= COMPLETE_PAIRS


def _scaled(z: Tensor, level: Level) -> Tensor:
    if level.scale == 1:
        return z
    return resize(z, (level.extent(z.shape[1]), level.extent(z.shape[2])))


def _scaled_mask(mask: Tensor | None, level: Level) -> Tensor | None:
    if mask is None or level.scale == 1:
        return mask
    size = (level.extent(mask.shape[0]), level.extent(mask.shape[1]))
    return resize(mask[None].float(), size)[0] > 0.95


def _carried(
    model: TextureModel,
    fit: Fit,
    x: Tensor,
    exemplars: Sequence[Tensor],
    masks: Sequence[Tensor | None],
    grid: Grid,
) -> Tensor:
    """The texture of the next scale, rendered from the labels of the last one.

    The labels point into the sharp exemplar, so detail comes back at once; an enlarged texture
    would be blurred, and blurred neighborhoods match the dull parts of the exemplar.
    """
    factors = (grid.height / x.shape[1], grid.width / x.shape[2])
    wide = round(model.grid.size * factors[0])
    shapes = tuple((z.shape[1], z.shape[2]) for z in exemplars)
    space = label_space(shapes, wide, masks)
    if wide > min(grid.height, grid.width) or not len(space):
        return resize(x, (grid.height, grid.width))
    finer = Grid(grid.height, grid.width, wide, max(1, wide // 4), grid.periodic)
    positions = _carried_positions(model, fit.labels[0], finer, factors, shapes)
    lost = space.at(positions) < 0
    if bool(lost.any()):  # a mask that leaves no place there
        positions[lost] = space.positions[0]
    weights = (~lost).to(x) + 1e-6
    return LabelField(finer, positions, weights, shapes).apply(exemplars)


def _field(
    model: TextureModel, labels: Tensor, x: Tensor, exemplars: Sequence[Tensor]
) -> LabelField:
    """Labels of a level with the robust weights that they have at x."""
    energy = model.energy(labels)
    weights = energy.site_weights(energy.distances(x))
    shapes = tuple((z.shape[1], z.shape[2]) for z in exemplars)
    return LabelField(model.grid, model.space.positions[labels], weights, shapes)


def _composed(model: TextureModel, fit: Fit, x: Tensor, exemplars: Sequence[Tensor]) -> Tensor:
    """Every pixel from the window that weighs most: sharp, with seams for the next level to mend.

    Where large windows disagree their mean is blurred, and the small windows that follow would
    match the blur to whatever is flat in the exemplar.
    """
    field = _field(model, fit.labels[0], x, exemplars)
    which, row, col = field.source_map().unbind(-1)
    whole = torch.empty_like(x)
    for number, z in enumerate(exemplars):
        here = which == number
        whole[:, here] = z[:, row[here], col[here]]
    return whole


def _carried_positions(
    model: TextureModel,
    labels: Tensor,
    finer: Grid,
    factors: tuple[float, float],
    shapes: Sequence[tuple[int, int]],
) -> Int[Tensor, "n 3"]:
    old, half = model.grid, finer.size / 2
    device = labels.device
    picks, shifts = [], []
    for axis, (sites, olds) in enumerate(((finer.rows, old.rows), (finer.cols, old.cols))):
        centres = (sites + half) / factors[axis]
        gaps = centres[:, None] - (olds + old.size / 2)[None]
        pick = gaps.abs().argmin(1)
        picks.append(pick.to(device))
        shifts.append(gaps.gather(1, pick[:, None])[:, 0].to(device))
    place = model.space.positions[labels].view(*old.shape, 3)[picks[0]][:, picks[1]]
    which = place[..., 0]
    limits = torch.tensor(shapes, device=device)[which] - finer.size
    row = (place[..., 1] + old.size / 2 + shifts[0][:, None]) * factors[0] - half
    col = (place[..., 2] + old.size / 2 + shifts[1][None]) * factors[1] - half
    spots = torch.stack([row, col], -1).round().long().clamp(min=0)
    spots = torch.minimum(spots, limits)
    return torch.cat([which[..., None], spots], -1).view(-1, 3)


def _reporter(
    on_step: Callable[[Progress], None] | None,
    number: int,
    plan: Sequence[Level],
    work: Sequence[int],
) -> Callable[[HalfStep], None] | None:
    if on_step is None:
        return None

    def report(half: HalfStep) -> None:
        level = plan[number]
        share = (2 * half.step + (1 if half.half == "M" else 2)) / (2 * level.steps)
        done = (sum(work[:number]) + share * work[number]) / sum(work)
        on_step(Progress(number, len(plan), level, half, done))

    return report
