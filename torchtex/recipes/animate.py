"""Textures that move along a flow: frame by frame, each steered by the one before.

A label per window, moved and rounded by itself, would tear coherent pieces apart: neighbors get
offsets a pixel apart here and there, and their average is blurred. Pieces move by their mean
motion, and what the flow asks beyond that is remembered.

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
from numpy.typing import NDArray
from torch import Tensor

from torchtex.carry import composed, weighed_field
from torchtex.controls import SoftConstraint
from torchtex.energy import Energy, Objective
from torchtex.estep import ClosedForm
from torchtex.flow.fields import Flow, Given, Scaled, Summed, check_fields
from torchtex.flow.warps import invert, jacobian, warp
from torchtex.image import atomic_write
from torchtex.inputs import check_seed
from torchtex.labels import LabelField, label_arrays, label_field
from torchtex.model import LabelSpace, Search, TextureModel, fast_search, label_space, texture_model
from torchtex.neighborhoods import Grid
from torchtex.quadratic import threads
from torchtex.sources import UNREADABLE
from torchtex.synthesize import synthesize

APART = 1.0
"""A piece splits where the flow leads further than this from its mean motion, in pixels."""

INSIDE = 0.02
"""Weight of a pixel to be replaced, against 1 of those around, in the search for a patch."""

VISIBLE = 0.9
"""From this confidence on a pixel is the same in both frames, and the warp error counts it."""


@dataclass(frozen=True)
class Motion:
    """How a frame follows from the one before.

    Args:
        size: of the windows that mend seams, in pixels.
        patch: side of the squares of the exemplar that replace worn content.
        stretch: how far content may be stretched, sheared or turned before it is made anew; 0.25
            is a quarter, or 14 degrees. Small values keep the exemplar's shapes, large ones make
            content live longer.
        hold: share by which a new label has to be nearer than the one moved along. Small values
            mend more, and make frames flat over time.
        r: robust exponent.

    Raises:
        ValueError: a number out of range.

    Example:
        >>> Motion().patch
        32
    """

    size: int = 8
    patch: int = 32
    stretch: float = 0.25
    hold: float = 0.4
    r: float = 0.8

    def __post_init__(self) -> None:
        if self.size < 2:
            raise ValueError(f"size={self.size} must be at least 2")
        if self.patch < self.size:
            raise ValueError(f"patch={self.patch} must be at least size={self.size}")
        if not 0 < self.stretch < math.inf:
            raise ValueError(f"stretch={self.stretch} must be above 0, and finite")
        if not 0 <= self.hold <= 1:
            raise ValueError(f"hold={self.hold} must lie in 0..1")
        if not 0 < self.r <= 2:
            raise ValueError(f"r={self.r} must lie in (0, 2]")


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
        drift: (n, 2), how far each window should be from where `field` has it.
        wear: (h, w), how far the content of each pixel has been stretched since it was made.
    """

    number: int
    texture: Float[Tensor, "c h w"]
    field: LabelField
    confidence: Float[Tensor, "h w"]
    warp_error: float
    seconds: float
    drift: Float[Tensor, "n 2"]
    wear: Float[Tensor, "h w"]


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
            drift=frame.drift.cpu().numpy(),
            wear=frame.wear.cpu().numpy(),
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
                torch.from_numpy(file["drift"]),
                torch.from_numpy(file["wear"]),
            )
            return frame, str(file["about"])
    except UNREADABLE as error_:
        raise ValueError(
            f"state={path} is not the state of an animation ({error_}); delete it"
        ) from None


def pieces(grid: Grid, positions: Int[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """Number of the piece of each window: neighbors with one offset into one exemplar.

    Example:
        >>> grid = Grid(8, 12, 4, 4)
        >>> places = torch.cat([torch.zeros(6, 1).long(), grid.sites], 1)
        >>> places[2, 2] += 1
        >>> pieces(grid, places).tolist()
        [0, 0, 1, 0, 0, 0]
    """
    ny, nx = grid.shape
    offsets = positions.cpu().clone()
    offsets[:, 1:] -= grid.sites
    keys = offsets.view(ny, nx, 3)
    across = (keys[:, 1:] == keys[:, :-1]).all(2)
    down = (keys[1:] == keys[:-1]).all(2)
    number = torch.arange(ny * nx).view(ny, nx)
    while True:
        least = number.clone()
        for there, one, two in (
            (across, least[:, :-1], least[:, 1:]),
            (down, least[:-1], least[1:]),
        ):
            both = torch.minimum(one, two)
            one.copy_(torch.where(there, both, one))
            two.copy_(torch.where(there, torch.minimum(both, two), two))
        flat = least.flatten()
        # the number that a window has is itself a window, of a number at most as large: jump
        flat = torch.minimum(
            flat, number.flatten().scatter_reduce(0, number.flatten(), flat, "amin")
        )
        for _ in range(3):
            flat = flat[flat]
        if torch.equal(flat, number.flatten()):
            return flat.unique(return_inverse=True)[1]
        number = flat.view(ny, nx)


def moved_pieces(
    model: TextureModel,
    field: LabelField,
    drift: Float[Tensor, "m 2"],
    backward: Float[Tensor, "2 h w"],
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 2"]]:
    """Labels of a model's sites taken over from a label field, moved along a flow.

    A site takes the label of the window nearest to where its centre came from, shifted by the
    distance between the two, and by the mean of that over its piece.

    Args:
        drift: how far each window of `field` should already be from where it is.
        backward: where each pixel came from, from its own place.

    Returns:
        Labels, and the drift of each.

    Example:
        >>> z = torch.rand(1, 16, 16)
        >>> model = texture_model([z], Grid(12, 12, 4, 2))
        >>> where = torch.cat([torch.zeros(25, 1).long(), model.grid.sites + 2], 1)
        >>> field = LabelField(model.grid, where, torch.ones(25), ((16, 16),))
        >>> back = torch.full((2, 12, 12), 0.75)
        >>> labels, drift = moved_pieces(model, field, torch.zeros(25, 2), back)
        >>> model.space.positions[labels[0]].tolist(), drift[0].tolist()
        ([0, 3, 3], [-0.25, -0.25])
    """
    grid, old = model.grid, field.grid
    device = field.positions.device
    sites = grid.sites.to(device)
    at = (sites + grid.size // 2) % torch.tensor([grid.height, grid.width], device=device)
    spot = sites.double() + grid.size / 2 + backward[:, at[:, 0], at[:, 1]].T.double()
    picks, shifts = [], []
    for axis, starts in enumerate((old.rows, old.cols)):
        extent = (old.height, old.width)[axis]
        gaps = spot[:, axis, None] - (starts.to(device) + old.size / 2)[None]
        if old.periodic:
            gaps = (gaps + extent / 2) % extent - extent / 2
        pick = gaps.abs().argmin(1)
        picks.append(pick)
        shifts.append(gaps.gather(1, pick[:, None])[:, 0])
    source = picks[0] * old.shape[1] + picks[1]
    place = field.positions[source]
    wished = place[:, 1:] + drift[source].double() + torch.stack(shifts, 1)
    wished = wished + (old.size - grid.size) / 2
    group = pieces(old, field.positions)[source.cpu()].numpy()
    start = sites + _rigid((wished - sites).cpu().numpy(), group).to(device)
    limits = torch.tensor(field.shapes, device=device)[place[:, 0]] - grid.size
    start = torch.minimum(start.clamp(min=0), limits)
    labels = model.space.at(torch.cat([place[:, :1], start], 1))
    rest = (wished - start).clamp(-3 * APART, 3 * APART)
    return labels.clamp(min=0), rest  # a mask may leave label 0; the search finds a better one


def _rigid(offsets: NDArray[np.float64], group: NDArray[np.int64]) -> Int[Tensor, "n 2"]:
    """The mean offset of each group, rounded; groups that spread too far are split."""
    far = np.round((offsets - _mean(offsets, group)) / (2 * APART)).astype(np.int64)
    # wrapped windows of a periodic grid make groups spread by whole extents, and split there
    keys = np.concatenate([group[:, None], far], 1)
    split = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    return torch.from_numpy(np.round(_mean(offsets, split)).astype(np.int64))


def _mean(
    values: NDArray[np.float64],
    group: NDArray[np.int64],
    counted: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Mean of each group, at each of its members; 0 where none counts."""
    one = np.ones(len(group)) if counted is None else counted
    count = np.maximum(np.bincount(group, one), 1)
    return np.stack([(np.bincount(group, v * one) / count)[group] for v in values.T], 1)


def joined_drift(
    field: LabelField, drift: Float[Tensor, "n 2"], stayed: Tensor
) -> Float[Tensor, "n 2"]:
    """The drift of windows that stayed, and for others the mean over those of their piece.

    Example:
        >>> grid = Grid(4, 8, 4, 4)
        >>> places = torch.cat([torch.zeros(2, 1).long(), grid.sites], 1)
        >>> field = LabelField(grid, places, torch.ones(2), ((4, 8),))
        >>> drift = torch.tensor([[0.5, 0.0], [9.0, 9.0]], dtype=torch.float64)
        >>> joined_drift(field, drift, torch.tensor([True, False])).tolist()
        [[0.5, 0.0], [0.5, 0.0]]
    """
    group = pieces(field.grid, field.positions).numpy()
    kept = stayed.cpu().numpy().astype(np.float64)
    mean = torch.from_numpy(_mean(drift.cpu().double().numpy(), group, kept)).to(drift)
    return torch.where(stayed[:, None], drift, mean)


@dataclass(frozen=True)
class Patches:
    """Squares of the exemplars that replace what is worn out; built by `patches_of`.

    Args:
        side: of a patch.
        ring: pixels around it that have to fit.
        space: places of patches with their rings.
        exemplars: they.
        periodic: frames are tiles.
    """

    side: int
    ring: int
    space: LabelSpace
    exemplars: Sequence[Tensor]
    periodic: bool

    def renew(
        self, image: Float[Tensor, "c h w"], wear: Float[Tensor, "h w"], limit: float, most: int
    ) -> tuple[Float[Tensor, "h w"], list[tuple[int, int, int, int, int]]]:
        """Puts patches where the wear is above the limit, the most worn first.

        Returns:
            The wear left, 0 in patches; and of each patch its row and column in the image and
            the exemplar, row and column that it shows there.
        """
        wear, image, done = wear.clone(), image.clone(), []
        h, w = wear.shape
        half, box = max(1, self.side // 2), self.side + 2 * self.ring
        every = torch.arange(box, device=image.device)
        for _ in range(most):
            mean = F.avg_pool2d(wear[None, None], half, 1)[0, 0]
            top = int(mean.argmax())
            if float(mean.flatten()[top]) <= limit:
                break
            corner = []
            for start, extent in zip(divmod(top, mean.shape[1]), (h, w), strict=True):
                first = start - (self.side - half) // 2
                corner.append(
                    first % extent if self.periodic else min(max(first, 0), extent - self.side)
                )
            begin = [
                (first - self.ring) % extent
                if self.periodic
                else min(max(first - self.ring, 0), extent - box)
                for first, extent in zip(corner, (h, w), strict=True)
            ]
            inner = [(first - b) % e for first, b, e in zip(corner, begin, (h, w), strict=True)]
            rows, cols = ((b + every) % e for b, e in zip(begin, (h, w), strict=True))
            here = rows[:, None], cols[None]
            patch = slice(inner[0], inner[0] + self.side), slice(inner[1], inner[1] + self.side)
            weight = (wear[here] <= limit).to(image)
            weight[patch] *= INSIDE
            which, row, col = self._nearest(image[:, rows[:, None], cols[None]], weight + 1e-3)
            row, col = row + inner[0], col + inner[1]
            at = rows[patch[0]][:, None], cols[patch[1]][None]
            shown = self.exemplars[which][:, row : row + self.side, col : col + self.side]
            image[:, at[0], at[1]] = shown
            wear[at] = 0
            done.append((corner[0], corner[1], which, row, col))
        return wear, done

    def _nearest(self, wished: Tensor, weight: Tensor) -> tuple[int, int, int]:
        best, found = float("inf"), (0, 0, 0)
        box = len(weight)
        for number, (z, table) in enumerate(zip(self.exemplars, self.space.tables, strict=True)):
            if min(z.shape[1:]) < box:
                continue
            with threads(1):  # sums depend on their number
                energy = F.conv2d(z.square().sum(0)[None, None], weight[None, None])[0, 0]
                cost = energy - 2 * F.conv2d(z[None], (wished * weight)[None])[0, 0]
            free = table[: cost.shape[0], : cost.shape[1]] >= 0
            cost = torch.where(free, cost, torch.full_like(cost, torch.inf))
            least = int(cost.argmin())
            if float(cost.flatten()[least]) < best:
                best, found = float(cost.flatten()[least]), (number, *divmod(least, cost.shape[1]))
        return found


def patches_of(
    exemplars: Sequence[Float[Tensor, "c _ _"]],
    masks: Sequence[Tensor | None] | None,
    grid: Grid,
    side: int,
) -> Patches | None:
    """Patches of at most that side that fit the exemplars, their masks and a frame; else None.

    Example:
        >>> patches_of([torch.rand(1, 64, 64)], None, Grid(64, 64, 8, 2), 32).side
        32
    """
    least = min(grid.height, grid.width, max(min(z.shape[1:]) for z in exemplars))
    side = min(side, least // 2)
    shapes = [(z.shape[1], z.shape[2]) for z in exemplars]
    while side >= grid.size:
        ring = max(grid.size // 2, side // 3)
        if side + 2 * ring <= least:
            space = label_space(shapes, side + 2 * ring, masks, device=exemplars[0].device)
            if len(space):
                return Patches(side, ring, space, exemplars, grid.periodic)
        side = side * 3 // 4
    return None


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

    The first frame is a synthesis. Every other shows the pieces of the exemplar that the last one
    shows, moved by the flow as wholes, with the exemplar's own orientation and size. Where that
    has worn them out, or the flow brings in new pixels, patches of the exemplar that fit their
    surroundings replace them, and small windows mend the seams.

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
    model: TextureModel | None = None
    patches: Patches | None = None
    frame, home = resume, None
    if frame is None or loop:
        first = _first(zs, size, masks, motion, periodic, search, seed)
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
        if model is None:
            model = _model(zs, keep, size, motion, periodic, search, seed)
            patches = patches_of(zs, keep, model.grid, motion.patch)
        frame = _next(frame, number, field, model, patches, zs, motion, home, began)
        if on_frame is not None:
            on_frame(frame)
        yield frame


def _first(
    zs: Sequence[Tensor],
    size: tuple[int, int],
    masks: Tensor | Sequence[Tensor | None] | None,
    motion: Motion,
    periodic: bool,
    search: Search | None,
    seed: int,
) -> Frame:
    still = synthesize(
        zs, size, masks=masks, boundary="periodic" if periodic else "free", search=search, seed=seed
    )
    seen = torch.zeros(size).to(still.texture)
    drift = torch.zeros(len(still.field.positions), 2, dtype=torch.float64)
    # worn differently, or all of the first frame would be made anew at once
    generator = torch.Generator().manual_seed(seed)
    cells = torch.rand(1, -(-size[0] // 24), -(-size[1] // 24), generator=generator)
    wear = cells.repeat_interleave(24, 1).repeat_interleave(24, 2)[0, : size[0], : size[1]].double()
    return Frame(
        0, still.texture, still.field, seen, 0.0, still.seconds, drift.to(seen.device),
        (motion.stretch * wear).to(seen.device),
    )  # fmt: skip


def _model(
    zs: Sequence[Tensor],
    masks: Sequence[Tensor | None] | None,
    size: tuple[int, int],
    motion: Motion,
    periodic: bool,
    search: Search | None,
    seed: int,
) -> TextureModel:
    """Exemplars and their index, made ready once for all frames."""
    if motion.size > min(*size, max(min(z.shape[1:]) for z in zs)):
        raise ValueError(
            f"size={motion.size}: no window fits an exemplar and frames of {size[0]}x{size[1]}; "
            "choose a smaller one"
        )
    return texture_model(
        zs, Grid(*size, motion.size, max(1, motion.size // 4), periodic),
        search=fast_search() if search is None else search, r=motion.r, masks=masks,
        generator=torch.Generator().manual_seed(seed),
    )  # fmt: skip


def _next(
    last: Frame,
    number: int,
    flow: Tensor,
    model: TextureModel,
    patches: Patches | None,
    zs: Sequence[Tensor],
    motion: Motion,
    home: "_Home | None",
    began: float,
) -> Frame:
    """Pieces moved, what is worn out replaced, seams mended."""
    periodic = model.grid.periodic
    backward, seen = invert(flow, periodic=periodic)
    backward, confidence = backward.to(last.texture), seen.to(last.texture)
    warped = warp(last.texture, backward, periodic=periodic).clamp(0, 1)
    moved, drift = moved_pieces(model, last.field, last.drift, backward)
    # labels are carried, not pixels: those of the exemplar are sharp, moved ones are not
    x = composed(_placed(model, moved), zs)
    wear = _worn(last.wear, flow, backward, periodic)
    wear = torch.where(_lost(model, drift), 2 * motion.stretch, wear)
    labels, fresh = moved, torch.zeros_like(moved, dtype=torch.bool)
    if patches is not None:
        most = max(4, 3 * wear.numel() // (4 * patches.side**2) // 4)
        wear, done = patches.renew(x, wear, motion.stretch, most)
        wear = wear.clamp(max=motion.stretch)
        for patch in done:
            labels, confidence, here = _patched(model, labels, confidence, patch, patches.side)
            fresh = fresh | here
        if done:
            x = composed(_placed(model, labels), zs)
    labels = _nearer(model, x, labels, motion.hold)
    controls: list[tuple[float, Energy]] = []
    if home is not None and home.share(number) > 0:
        controls.append(home.control(number, float(_weight(model, labels, x))))
    if controls:  # on the way home pixels are pulled, and labels follow
        for _ in range(2):
            x = ClosedForm()(Objective(((1.0, model.energy(labels)), *controls)), x)
            labels = model.match(x, labels)
    field = weighed_field(model, labels, x, zs)
    drift = joined_drift(field, drift, (labels == moved) & ~fresh)
    texture = (x if controls else composed(field, zs)).clamp(0, 1)
    error = warp_error(texture, warped, confidence)
    seconds = time.perf_counter() - began
    return Frame(number, texture, field, confidence, error, seconds, drift, wear)


def _worn(wear: Tensor, flow: Tensor, backward: Tensor, periodic: bool) -> Tensor:
    """The wear moved along, and more where the flow does not just shift."""
    unit = torch.eye(2, dtype=torch.float64, device=flow.device)[:, :, None, None]
    change = (jacobian(flow.double(), periodic=periodic) - unit).square().sum((0, 1)) / 2
    more = (wear + change.sqrt())[None]
    return warp(more, backward.double(), periodic=periodic, cubic=False)[0]


def _lost(model: TextureModel, drift: Tensor) -> Tensor:
    """Pixels whose window cannot follow, since its exemplar ends there."""
    grid = model.grid
    far = (drift.abs() > 2 * APART).any(1).view(grid.shape)
    near = []
    for starts, extent in ((grid.rows, grid.height), (grid.cols, grid.width)):
        centres = starts + (grid.size - 1) / 2
        near.append((torch.arange(extent)[:, None] - centres[None]).abs().argmin(1))
    return far[near[0].to(far.device)[:, None], near[1].to(far.device)[None]]


def _patched(
    model: TextureModel,
    labels: Tensor,
    confidence: Tensor,
    patch: tuple[int, int, int, int, int],
    side: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Labels with those of a patch, the confidence without it, and which labels are its own."""
    grid = model.grid
    first, extent = torch.tensor(patch[:2]), torch.tensor([grid.height, grid.width])
    gap = (grid.sites + grid.size // 2 - first) % extent
    here = (gap < side).all(1).to(labels.device)
    place = torch.cat(
        [torch.full((len(gap), 1), patch[2]), gap - grid.size // 2 + torch.tensor(patch[3:])], 1
    )
    found = model.space.at(place.to(labels.device))
    here &= found >= 0
    rows, cols = ((first[k] + torch.arange(side)) % extent[k] for k in (0, 1))
    confidence = confidence.clone()
    confidence[rows[:, None], cols[None]] = 0
    return torch.where(here, found, labels), confidence, here


def _nearer(model: TextureModel, x: Tensor, labels: Tensor, hold: float) -> Tensor:
    """The M-step, but a label stays unless the new one is nearer by that share."""
    found = model.match(x, labels)
    channels, nx = model.windows.channels(x), model.grid.shape[1]
    better = []
    for band in model.windows.bands:
        some = slice(band.start * nx, band.stop * nx)
        queries = model.windows.vectors(channels, band)
        old, new = ((queries - model.targets(one[some])).square().sum(1) for one in (labels, found))
        better.append((new < (1 - hold) * old) & (old > model.eps**2 / 2))
    return torch.where(torch.cat(better), found, labels)


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

    def share(self, number: int) -> float:
        """How far the way back is at a frame; not above 0 before it begins."""
        return (number - (self.frames - 1 - self.loop)) / (self.loop + 1)

    def control(self, number: int, pull: float) -> tuple[float, Energy]:
        """A constraint that grows from nothing to all over the last frames."""
        share, image = self.share(number), self.first
        confidence = torch.ones_like(image[0])
        size = (image.shape[1], image.shape[2])
        for step in reversed(range(number, self.frames)):
            field = _field_at(self.flow, step, size).to(image)
            # the flow leads from this frame to the next one, so it says where to read
            image = warp(image, field, periodic=self.periodic).clamp(0, 1)
            confidence = warp(confidence[None], field, periodic=self.periodic, cubic=False)[0]
            confidence = confidence * _kept(field, self.periodic)
        weight = 4 * pull * share / max(1 - share, 1e-3)
        return weight, SoftConstraint(image, confidence.clamp(0, 1))


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
