"""Textures that move along a flow: frame by frame, each steered by the one before.

Source: Kwatra et al. 2005, section 4.1 and Algorithm 2; what they compare with in figure 7, and
the regenerated texture of Neyret 2003.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from kornia.filters import gaussian_blur2d
from torch import Tensor

from torchtex.carry import composed, weighed_field
from torchtex.controls import SoftConstraint
from torchtex.energy import Energy, Objective
from torchtex.estep import ClosedForm
from torchtex.flow.fields import Flow, Given, Scaled, Summed, check_fields
from torchtex.flow.warps import invert, warp
from torchtex.image import atomic_write
from torchtex.labels import LabelField, label_arrays, label_field
from torchtex.model import LabelSpace, Search, TextureModel, fast_search, texture_model
from torchtex.neighborhoods import Grid
from torchtex.recipes.inputs import check_seed
from torchtex.sources import UNREADABLE
from torchtex.synthesize import synthesize

VISIBLE = 0.9
"""From this confidence on a pixel is the same in both frames, and the warp error counts it."""


@dataclass(frozen=True)
class Motion:
    """How a frame follows from the one before.

    Args:
        sizes: windows in pixels, large before small, all at full scale.
        steps: EM iterations of each.
        pull: strength of the warped frame, in units of the average weight of the texture energy
            in a pixel; 0 frees the texture, large values only warp.
        sharpen: share of the finest detail of the warped frame that is added to it again, since
            reading between pixels and averaging windows take it away.
        r: robust exponent.

    Raises:
        ValueError: no sizes, another number of steps, or a number out of range.

    Example:
        >>> Motion().sizes
        (16, 8)
    """

    sizes: tuple[int, ...] = (16, 8)
    steps: tuple[int, ...] = (1, 2)
    pull: float = 0.5
    sharpen: float = 0.2
    r: float = 0.8

    def __post_init__(self) -> None:
        if not self.sizes or len(self.sizes) != len(self.steps):
            raise ValueError(
                f"sizes={self.sizes} and steps={self.steps} must be as many, at least one"
            )
        if min(self.sizes) < 2 or min(self.steps) < 1:
            raise ValueError(
                f"sizes={self.sizes} must be at least 2, steps={self.steps} at least 1"
            )
        if not 0 <= self.pull < math.inf:
            raise ValueError(f"pull={self.pull} must be at least 0, and finite")
        if not 0 <= self.sharpen <= 1:
            raise ValueError(f"sharpen={self.sharpen} must lie in 0..1")
        if not 0 < self.r <= 2:
            raise ValueError(f"r={self.r} must lie in (0, 2]")

    def steps_of(self, models: Sequence[TextureModel]) -> list[int]:
        """EM iterations of models, by the size of their windows."""
        steps = dict(zip(self.sizes, self.steps, strict=True))
        return [steps[model.grid.size] for model in models]


@dataclass(frozen=True)
class Frame:
    """One frame of an animation.

    Args:
        number: from 0.
        texture: (c, h, w) in [0, 1].
        field: where its windows came from; renders aligned maps.
        confidence: (h, w), how far each pixel was already to be seen in the frame before; 0 all
            over in the first.
        warp_error: root mean square difference from the warped frame before, where that is
            seen; 0 in the first.
        seconds: that it took.
    """

    number: int
    texture: Float[Tensor, "c h w"]
    field: LabelField
    confidence: Float[Tensor, "h w"]
    warp_error: float
    seconds: float


def save_frame(path: str | Path, frame: Frame, about: str = "") -> None:
    """Writes a frame as an .npz file that `animate(resume=...)` can go on from.

    Args:
        about: kept with it, for the caller to recognise.

    Example:
        >>> import tempfile
        >>> from torchtex.flow.fields import Uniform
        >>> frame = next(animate(torch.rand(1, 32, 32), (32, 32), Uniform((0.0, 1.0)), 2))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_frame(f"{folder}/f.npz", frame)
        ...     load_frame(f"{folder}/f.npz")[0].number
        0
    """
    arrays = label_arrays(frame.field)
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            number=np.array(frame.number),
            texture=frame.texture.cpu().numpy(),
            confidence=frame.confidence.cpu().numpy(),
            numbers=np.array([frame.warp_error, frame.seconds]),
            about=np.array(about),
            **arrays,
        )


def load_frame(path: str | Path) -> tuple[Frame, str]:
    """Reads what `save_frame` wrote: the frame, and what was kept with it.

    Raises:
        ValueError: no such file, or another kind of file.
    """
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            error, seconds = (float(number) for number in file["numbers"])
            frame = Frame(
                int(file["number"]),
                torch.from_numpy(file["texture"]),
                label_field(file),
                torch.from_numpy(file["confidence"]),
                error,
                seconds,
            )
            return frame, str(file["about"])
    except UNREADABLE as error_:
        raise ValueError(
            f"state={path} is not the state of an animation ({error_}); delete it"
        ) from None


def animate(
    exemplars: Float[Tensor, "c _ _"] | Sequence[Float[Tensor, "c _ _"]],
    size: tuple[int, int],
    flow: Flow,
    frames: int,
    *,
    masks: Bool[Tensor, "_ _"] | Sequence[Bool[Tensor, "_ _"] | None] | None = None,
    motion: Motion = Motion(),
    boundary: str = "free",
    loop: int = 0,
    search: Search | None = None,
    seed: int = 0,
    resume: Frame | None = None,
    on_frame: Callable[[Frame], None] | None = None,
) -> Iterator[Frame]:
    """Frames of a texture that moves along a flow and stays a texture; made as they are asked for.

    The first frame is a synthesis. Every other starts from the last one, moved by the flow, and
    is held to it where the flow says that a pixel was already to be seen. New labels compete with
    those of the last frame, moved along: the exemplar's own orientation and size are kept, since
    labels are shifted and not turned.

    Memory does not grow with the number of frames.

    Args:
        exemplars: one image or several, as in `synthesize`.
        size: height and width of a frame.
        flow: where pixels go; see `flow.fields.Flow`.
        frames: how many.
        masks: True where an exemplar may be used.
        motion: how a frame follows from the one before.
        boundary: "periodic" for frames that tile.
        loop: over so many frames at the end the texture returns to the first frame, which comes
            again after the last one; 0 does not.
        search: of the M-step; `fast_search()` unless given.
        seed: of the first frame.
        resume: go on after this frame of the same animation.
        on_frame: called with every frame; raise from it to cancel.

    Raises:
        ValueError: an option out of range, or a flow that is none; what `synthesize` refuses.

    Source: Kwatra et al. 2005, section 4.1.

    Example:
        >>> from torchtex.flow.fields import Uniform
        >>> moving = animate(torch.rand(1, 32, 32), (32, 40), Uniform((0.0, 2.0)), 3)
        >>> [frame.number for frame in moving]
        [0, 1, 2]
    """
    if frames < 1:
        raise ValueError(f"frames={frames} must be at least 1")
    if not 0 <= loop < frames:
        raise ValueError(f"loop={loop} must be at least 0 and below frames={frames}")
    if boundary not in ("free", "periodic"):
        raise ValueError(f"boundary={boundary!r} must be free or periodic")
    check_seed(seed)
    check_flow(flow, size, frames)
    return _frames(
        exemplars, size, flow, frames, masks, motion, boundary, loop, search, seed, resume, on_frame
    )  # fmt: skip


def _frames(
    exemplars: Tensor | Sequence[Tensor],
    size: tuple[int, int],
    flow: Flow,
    frames: int,
    masks: Tensor | Sequence[Tensor | None] | None,
    motion: Motion,
    boundary: str,
    loop: int,
    search: Search | None,
    seed: int,
    resume: Frame | None,
    on_frame: Callable[[Frame], None] | None,
) -> Iterator[Frame]:
    zs = [exemplars] if isinstance(exemplars, Tensor) else list(exemplars)
    keep = [masks] if isinstance(masks, Tensor) else masks
    periodic = boundary == "periodic"
    models: list[TextureModel] = []
    frame, home = resume, None
    if frame is None or loop:
        first = _first(zs, size, masks, periodic, search, seed)
        home = _Home(first.texture, flow, frames, loop, periodic) if loop else None
        if frame is None:
            frame = first
            if on_frame is not None:
                on_frame(frame)
            yield frame
        del first
    for number in range(frame.number + 1, frames):
        began = time.perf_counter()
        field = _field_at(flow, number - 1, size).to(frame.texture)
        if not models:
            models = _models(zs, keep, size, motion, periodic, search, seed)
        frame = _next(frame, number, field, models, zs, motion, home, began)
        if on_frame is not None:
            on_frame(frame)
        yield frame


def _first(
    zs: Sequence[Tensor],
    size: tuple[int, int],
    masks: Tensor | Sequence[Tensor | None] | None,
    periodic: bool,
    search: Search | None,
    seed: int,
) -> Frame:
    still = synthesize(
        zs, size, masks=masks, boundary="periodic" if periodic else "free", search=search, seed=seed
    )
    seen = torch.zeros(size).to(still.texture)
    return Frame(0, still.texture, still.field, seen, 0.0, still.seconds)


def _models(
    zs: Sequence[Tensor],
    masks: Sequence[Tensor | None] | None,
    size: tuple[int, int],
    motion: Motion,
    periodic: bool,
    search: Search | None,
    seed: int,
) -> list[TextureModel]:
    """One per window size; the indices over the exemplars are built once for all frames."""
    small = min(*size, max(min(z.shape[1:]) for z in zs))
    fitting = [window for window in motion.sizes if window <= small]
    if not fitting:
        raise ValueError(
            f"sizes={motion.sizes}: no window fits an exemplar and frames of "
            f"{size[0]}x{size[1]}; choose smaller ones"
        )
    generator = torch.Generator().manual_seed(seed)
    return [
        texture_model(
            zs, Grid(*size, window, max(1, window // 4), periodic),
            search=fast_search() if search is None else search, r=motion.r, masks=masks,
            generator=generator,
        )
        for window in fitting
    ]  # fmt: skip


def _next(
    last: Frame,
    number: int,
    flow: Tensor,
    models: Sequence[TextureModel],
    zs: Sequence[Tensor],
    motion: Motion,
    home: "_Home | None",
    began: float,
) -> Frame:
    """Algorithm 2 on one frame."""
    periodic = models[0].grid.periodic
    backward, confidence = invert(flow, periodic=periodic)
    backward, confidence = backward.to(last.texture), confidence.to(last.texture)
    warped = warp(last.texture, backward, periodic=periodic).clamp(0, 1)
    wished = _sharpened(warped, motion.sharpen, periodic)
    x, field, estep = wished, last.field, ClosedForm()
    for model, steps in zip(models, motion.steps_of(models), strict=True):
        labels = moved_labels(model, field, backward if field is last.field else None)
        # labels are carried, not pixels: those of the exemplar are sharp, moved ones are not
        x = composed(_placed(model, labels), x, zs)
        for _ in range(steps):
            labels = model.match(x, labels)
            pull = motion.pull * float(_weight(model, labels, x))
            controls: list[tuple[float, Energy]] = [(pull, SoftConstraint(wished, confidence))]
            if home is not None:
                controls += home.controls(number, pull)
            x = estep(Objective(((1.0, model.energy(labels)), *controls)), x)
        field = weighed_field(model, labels, x, zs)
    texture = x.clamp(0, 1)
    seconds = time.perf_counter() - began
    error = warp_error(texture, warped, confidence)
    return Frame(number, texture, field, confidence, error, seconds)


def _sharpened(image: Tensor, share: float, periodic: bool) -> Tensor:
    padded = F.pad(image[None], (1, 1, 1, 1), mode="circular" if periodic else "replicate")
    blurred = gaussian_blur2d(padded, (3, 3), (0.8, 0.8))[0, :, 1:-1, 1:-1]
    return (image + share * (image - blurred)).clamp(0, 1)


def _placed(model: TextureModel, labels: Tensor) -> LabelField:
    """Labels with equal weights: the window whose centre is nearest decides a pixel."""
    shapes = tuple((int(t.shape[0]), int(t.shape[1])) for t in model.space.tables)
    weights = torch.ones(len(labels)).to(model.keys)
    return LabelField(model.grid, model.space.positions[labels], weights, shapes)


def _weight(model: TextureModel, labels: Tensor, x: Tensor) -> Tensor:
    """Average weight of the texture energy in a pixel."""
    energy = model.energy(labels)
    weights = energy.site_weights(energy.distances(x))
    return weights.median() * len(weights) * model.grid.size**2 / (x.shape[1] * x.shape[2])


def moved_labels(
    model: TextureModel, field: LabelField, backward: Float[Tensor, "2 h w"] | None = None
) -> Int[Tensor, "n"]:
    """Labels of a model's sites taken over from a label field, moved along a flow.

    A site takes the label of the window nearest to where its centre came from, shifted by the
    distance between the two. Where that leaves the exemplar it is shifted back inside.

    Args:
        backward: where each pixel came from, from its own place; None for no motion.

    Example:
        >>> z = torch.rand(1, 16, 16)
        >>> model = texture_model([z], Grid(12, 12, 4, 2))
        >>> where = torch.cat([torch.zeros(25, 1).long(), model.grid.sites + 2], 1)
        >>> field = LabelField(model.grid, where, torch.ones(25), ((16, 16),))
        >>> bool((model.space.positions[moved_labels(model, field)] == where).all())
        True
    """
    grid, old = model.grid, field.grid
    device = field.positions.device
    sites = grid.sites.to(device)
    centre = sites.double() + grid.size / 2
    spot = centre
    if backward is not None:
        at = (sites + grid.size // 2) % torch.tensor([grid.height, grid.width], device=device)
        spot = centre + backward[:, at[:, 0], at[:, 1]].T.double()
    picks, shifts = [], []
    for axis, starts in enumerate((old.rows, old.cols)):
        extent = (old.height, old.width)[axis]
        gaps = spot[:, axis, None] - (starts.to(device) + old.size / 2)[None]
        if old.periodic:
            gaps = (gaps + extent / 2) % extent - extent / 2
        pick = gaps.abs().argmin(1)
        picks.append(pick)
        shifts.append(gaps.gather(1, pick[:, None])[:, 0])
    place = field.positions.view(*old.shape, 3)[picks[0], picks[1]]
    which = place[:, 0]
    shift = torch.stack(shifts, 1) + (old.size - grid.size) / 2
    limits = torch.tensor(field.shapes, device=device)[which] - grid.size
    start = (place[:, 1:] + shift).round().long().clamp(min=0)
    start = torch.minimum(start, limits)
    labels = model.space.at(torch.cat([which[:, None], start], 1))
    return _inside(model.space, labels)


def _inside(space: LabelSpace, labels: Tensor) -> Tensor:
    """Label 0 where a mask or a small exemplar leaves none; the search finds a better one."""
    return labels.clamp(min=0)


def warp_error(
    texture: Float[Tensor, "c h w"],
    warped: Float[Tensor, "c h w"],
    confidence: Float[Tensor, "h w"],
) -> float:
    """Root mean square difference of two images where the confidence is at least `VISIBLE`.

    Example:
        >>> warp_error(torch.ones(1, 2, 2), torch.zeros(1, 2, 2), torch.ones(2, 2))
        1.0
    """
    seen = confidence >= VISIBLE
    if not bool(seen.any()):
        return 0.0
    return float((texture - warped)[:, seen].square().mean().sqrt())


@dataclass(frozen=True)
class _Home:
    """The way back to the first frame: it, moved back in time from where it comes again."""

    first: Tensor
    flow: Flow
    frames: int
    loop: int
    periodic: bool

    def controls(self, number: int, pull: float) -> list[tuple[float, Energy]]:
        """A constraint that grows from nothing to all over the last frames."""
        share = (number - (self.frames - 1 - self.loop)) / (self.loop + 1)
        if share <= 0:
            return []
        image = self.first
        confidence = torch.ones_like(image[0])
        size = (image.shape[1], image.shape[2])
        for step in reversed(range(number, self.frames)):
            field = _field_at(self.flow, step, size).to(image)
            # the flow leads from this frame to the next one, so it says where to read
            image = warp(image, field, periodic=self.periodic).clamp(0, 1)
            confidence = warp(confidence[None], field, periodic=self.periodic, cubic=False)[0]
            confidence = confidence * _kept(field, self.periodic)
        weight = 4 * pull * share / max(1 - share, 1e-3)
        return [(weight, SoftConstraint(image, confidence.clamp(0, 1)))]


def _kept(field: Tensor, periodic: bool) -> Tensor:
    """1 where a pixel of this frame is still inside the next one."""
    if periodic:
        return torch.ones_like(field[0])
    _, h, w = field.shape
    row = torch.arange(h, device=field.device)[:, None] + field[0]
    col = torch.arange(w, device=field.device)[None] + field[1]
    return ((row >= 0) & (row <= h - 1) & (col >= 0) & (col <= w - 1)).to(field)


def check_flow(flow: Flow, size: tuple[int, int], frames: int = 2) -> None:
    """Refuses a flow whose first field is none, or is of another size, or that ends too early.

    Args:
        frames: how many it has to lead through.

    Raises:
        ValueError: NaN, another rank or size, a displacement larger than the frame, or too few
            given fields.

    Example:
        >>> from torchtex.flow.fields import Uniform
        >>> check_flow(Uniform((0.0, 1.0)), (8, 8))
    """
    _field_at(flow, 0, size)
    if frames > 2:
        for part in _given(flow):
            part(frames - 2, *size)


def _given(flow: Flow) -> list[Given]:
    """The parts of a flow that have an end. The last field of others may take long to make."""
    if isinstance(flow, Scaled):
        return _given(flow.flow)
    if isinstance(flow, Summed):
        return [given for part in flow.flows for given in _given(part)]
    return [flow] if isinstance(flow, Given) else []


def _field_at(flow: Flow, frame: int, size: tuple[int, int]) -> Tensor:
    field = flow(frame, *size)
    check_fields(field, "flow")
    if tuple(field.shape) != (2, *size):
        raise ValueError(
            f"flow has fields of {field.shape[-2]}x{field.shape[-1]} and size={size[0]}x{size[1]}; "
            "give both the same"
        )
    return field


def warped_frames(
    first: Float[Tensor, "c h w"], flow: Flow, frames: int, *, periodic: bool = False
) -> Iterator[Float[Tensor, "c h w"]]:
    """The plain warp: the first frame moved along, with nothing made new. For comparison.

    Each frame is read from the first one through the whole motion so far, so it is blurred once.

    Source: Kwatra et al. 2005, figure 7.

    Example:
        >>> from torchtex.flow.fields import Uniform
        >>> len(list(warped_frames(torch.rand(1, 8, 8), Uniform((0.0, 1.0)), 3)))
        3
    """
    size = (first.shape[1], first.shape[2])
    whole = torch.zeros(2, *size).to(first)
    yield first
    for frame in range(frames - 1):
        step = invert(_field_at(flow, frame, size).to(first), periodic=periodic)[0].to(first)
        # back one frame, and from there as far as that frame already goes
        whole = step + warp(whole, step, periodic=periodic, cubic=False)
        yield warp(first, whole, periodic=periodic).clamp(0, 1)


def regenerated_frames(
    first: Float[Tensor, "c h w"],
    flow: Flow,
    frames: int,
    *,
    life: int = 16,
    periodic: bool = False,
) -> Iterator[Float[Tensor, "c h w"]]:
    """Warps that start anew every `life` frames, three of them faded into each other.

    Source: Neyret 2003, Advected textures; the rival of Kwatra et al. 2005, figure 7.

    Example:
        >>> from torchtex.flow.fields import Uniform
        >>> len(list(regenerated_frames(torch.rand(1, 8, 8), Uniform((0.0, 1.0)), 5)))
        5
    """
    if life < 3:
        raise ValueError(f"life={life} must be at least 3 frames")
    size = (first.shape[1], first.shape[2])
    starts = [-life * phase // 3 for phase in range(3)]
    ways = [torch.zeros(2, *size).to(first) for _ in starts]
    for frame in range(frames):
        if frame:
            step = invert(_field_at(flow, frame - 1, size).to(first), periodic=periodic)[0]
            step = step.to(first)
            ways = [step + warp(way, step, periodic=periodic, cubic=False) for way in ways]
        ages = [(frame - start) % life for start in starts]
        ways = [torch.zeros_like(w) if a == 0 else w for a, w in zip(ages, ways, strict=True)]
        shares = [math.sin(math.pi * (age + 0.5) / life) ** 2 for age in ages]
        parts = [
            share * warp(first, way, periodic=periodic)
            for share, way in zip(shares, ways, strict=True)
        ]
        yield (sum(parts[1:], parts[0]) / sum(shares)).clamp(0, 1)
