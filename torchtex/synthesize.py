"""Coarse to fine: the whole synthesis, and its result."""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.carry import carried, composed, weighed_field
from torchtex.controls import Guide, Scaled, SoftConstraint
from torchtex.em import HalfStep, em
from torchtex.energy import Energy
from torchtex.estep import Auto, EStep
from torchtex.features import Feature, Pixels
from torchtex.image import check_image, resize
from torchtex.inputs import (
    Exemplars,
    Masks,
    check_exemplars,
    check_size,
    matching_masks,
)
from torchtex.model import Search, fast_search, texture_model
from torchtex.result import Checkpoint, Progress, Result, Trace
from torchtex.schedule import (
    Level,
    default_schedule,
    is_complete,
    planned,
    roomy,
    scaled,
    scaled_mask,
)
from torchtex.starts import Blocks, Start


def synthesize(
    exemplars: Exemplars,
    size: tuple[int, int],
    *,
    masks: Masks = None,
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
    on_level: Callable[["Checkpoint"], None] | None = None,
    resume: "Checkpoint | None" = None,
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
        on_level: called after each level with all that a later run needs to go on from there.
        resume: what `on_level` was given by a run of the same options; the levels that it holds
            are not run again, and the bits are those of a run in one go.

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
    keep = matching_masks(masks, zs)
    plan = planned(zs, keep, height, width, tuple(schedule or default_schedule()))
    if schedule is None:
        plan = roomy(plan, zs)
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
    settings = {
        "size": [height, width],
        "exemplars": [_digest(z) for z in zs],
        "masks": [None if mask is None else _digest(mask) for mask in keep],
        "feature": repr(feature),
        "r": r,
        "completeness": completeness,
        "start": repr(start or Blocks()) if init is None else "init",
        "schedule": [asdict(level) for level in plan],
        "boundary": boundary,
        "carry": carry,
        "search": repr(search),
        "estep": repr(estep),
        "controls": [[weight, type(control).__name__] for weight, control in controls],
        "guides": [guide.weight for guide in guides],
    }
    work = [level.steps * len(level.grid(height, width, False)) * level.size**2 for level in plan]
    state = Checkpoint(seed, settings, generator.get_state())
    if resume is not None:
        state = resume.checked(seed, settings, zs[0])
        generator.set_state(state.randomness)
    for number, level in enumerate(plan[len(state.traces) :], len(state.traces)):
        level_began = time.perf_counter()
        grid = level.grid(height, width, boundary == "periodic")
        smaller = [scaled(z, level) for z in zs]
        some = [scaled_mask(mask, level) for mask in keep]
        field = state.field
        if field is None:
            if init is None:
                x = (start or Blocks())(smaller, some, grid, generator)
            else:
                x = resize(init.to(zs[0]), (grid.height, grid.width))
        elif (field.grid.height, field.grid.width) != (grid.height, grid.width):
            if carry:
                x = carried(field, state.texture, smaller, some, grid)
            else:
                x = resize(state.texture, (grid.height, grid.width))
        elif carry and level.scale == 1 and not controls:
            x = composed(field, smaller)
        else:
            x = state.texture
        model = texture_model(
            smaller,
            grid,
            feature=feature,
            search=search,
            r=r,
            completeness=completeness if is_complete(level, grid, smaller) else 0.0,
            masks=some,
            guides=[g.at(level.scale, grid.height, grid.width) for g in guides],
            generator=generator,
        )
        terms = [
            (w, c.at(grid.height, grid.width) if isinstance(c, Scaled) else c) for w, c in controls
        ]
        report = _reporter(on_step, number, plan, work)
        fit = em(x, [model], terms, estep, steps=level.steps, on_step=report)
        labels = fit.labels[0]
        field = weighed_field(model, labels, fit.texture, smaller)
        seconds = time.perf_counter() - level_began
        trace = Trace(level, fit.energies, len(grid), seconds, fit.texture)
        traces = (*state.traces, trace)
        state = Checkpoint(seed, settings, generator.get_state(), traces, labels, field)
        if on_level is not None:
            on_level(state)
    assert state.field is not None
    assert state.labels is not None
    # one more reweighted mean of pixels, so that `apply` gives the same bits
    plain = isinstance(feature, Pixels) and not controls
    texture = (state.field.apply(zs) if plain else state.texture).clamp(0, 1)
    elapsed = time.perf_counter() - began
    if resume is not None:
        elapsed += sum(trace.seconds for trace in resume.traces)
    return Result(texture, state.labels, state.field, state.traces, elapsed, seed, settings)


def estimate_memory(shapes: Sequence[tuple[int, int]], size: tuple[int, int], channels: int) -> int:
    """Bytes a synthesis holds at its peak, about: images, keys and one band of windows."""
    texture = size[0] * size[1]
    exemplar = sum(h * w for h, w in shapes)
    band = 16384 * 64
    return 4 * (channels * (14 * texture + 60 * exemplar + 12 * band) + 80 * exemplar)


def _check(zs: Sequence[Tensor], size: tuple[int, int], boundary: str) -> tuple[int, int]:
    check_exemplars(zs)
    check_size(size, estimate_memory([(z.shape[1], z.shape[2]) for z in zs], size, len(zs[0])))
    if boundary not in ("free", "periodic"):
        raise ValueError(f'boundary="{boundary}" must be "free" or "periodic"')
    return size


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


def _digest(image: Tensor) -> str:
    """Shape and a few digits that tell one image from another."""
    digits = hashlib.sha256(image.cpu().contiguous().numpy().tobytes()).hexdigest()
    return f"{'x'.join(str(n) for n in image.shape)} {digits[:16]}"


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
