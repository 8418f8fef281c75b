"""Skeletal synthesis: only the coarse band is synthesised, details are copied along.

The exemplar is split into a coarse band and details. The band is synthesised, every pixel of the
new one remembers where it is from, the details come from there too, and the inverse transform
puts all together. With Haar a coarse pixel becomes a square of 2^levels pixels, copied whole.

What is copied is the band as well as its details: an average of windows under details of one
place is blurred, and shows the squares. So the texture is a montage, and its seams are moved to
where they show least before the details are added.

Source: Pan et al. 2009, Skeletal texture synthesis; the seams are ours, after Kwatra et al. 2003.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.bands import band_field, block_pixels
from torchtex.cuts.expansion import expand
from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.features import Feature
from torchtex.image import resize
from torchtex.inputs import (
    Exemplars,
    Masks,
    check_seed,
    check_size,
    memory_of,
    usable_exemplars,
)
from torchtex.model import LabelSpace, label_space
from torchtex.recipes.montage import Montage, Stage
from torchtex.result import Progress, Result
from torchtex.schedule import Level, default_schedule, roomy
from torchtex.sources import SourceField, copied, pixel_places
from torchtex.synthesize import synthesize
from torchtex.wavelets import every_shift, reach

_LEAST = 6  # side of the smallest windows of the coarse band
_STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0), (0, 2), (2, 0), (0, -2), (-2, 0),
          (0, 4), (4, 0), (0, -4), (-4, 0))  # fmt: skip
"""Blocks by which pieces are offered to grow, one move after another."""


def skeleton(
    exemplars: Exemplars,
    size: tuple[int, int],
    *,
    levels: int = 1,
    wavelet: str = "haar",
    phases: int = 1,
    cut: Literal["mincut", "none"] = "mincut",
    solver: MinCut | None = None,
    feature: Feature | None = None,
    schedule: Sequence[Level] | None = None,
    boundary: Literal["free", "periodic"] = "free",
    masks: Masks = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """A texture whose coarse band is synthesised, and whose details are copied with it.

    A size that 2^levels does not divide is made larger and cropped; of an exemplar the rows and
    columns that fill no block are left out. The settings say how much.

    Args:
        exemplars: one image, or several with equal channels.
        size: (height, width) of the texture.
        levels: how often the images are halved; each makes the work about four times less.
        wavelet: "haar" copies pixels. A longer one, such as "db2", blends them across seams, since
            its filters reach into the next block (see `bands.BandField`).
        phases: shifts of the exemplar, along each axis, that give a coarse exemplar each; a power
            of 2, at most 2^levels.
        cut: "mincut" moves seams between pieces to where they show least, "none" leaves them.
        solver: of the cut; None for the first one that is installed.
        feature: what is compared in the coarse band; pixels unless given.
        schedule: of the coarse band, relative to it; the part of `default_schedule` that is as
            coarse unless given.
        boundary: "periodic" makes a texture that tiles; 2^levels must divide its size.
        masks: True where an exemplar may be used; one per exemplar.
        seed: same seed, same machine: same bits.
        on_step: called after each half-step and each move of seams; may raise to cancel.

    Raises:
        ValueError: an option out of range, or exemplars or a size that are too small.
        ImportError: no solver for the cut is installed.

    Source: Pan et al. 2009, sections 3 and 4.

    Example:
        >>> result = skeleton(torch.rand(3, 40, 40), (48, 56), cut="none")
        >>> result.texture.shape
        torch.Size([3, 48, 56])
    """
    began = time.perf_counter()
    zs, keep = usable_exemplars(exemplars, masks)
    check_seed(seed)
    shape = _Shape(size, levels, wavelet, phases, boundary)
    shape.check(zs)
    if cut not in ("mincut", "none"):
        raise ValueError(f"cut={cut!r} is unknown; choose mincut or none")
    if cut == "mincut":
        solver = default_solver() if solver is None else solver
    elif solver is not None:
        raise ValueError("solver belongs to cut=mincut; leave it out")
    space = shape.places(zs, keep)
    coarse = [shape.coarse(z) for z in zs]
    plan = _plan(coarse[0], shape) if schedule is None else tuple(schedule)
    pictures, usable, corners = shape.exemplars(coarse, space)
    report = _reporter(on_step, size, 0.8 if cut == "mincut" else 1.0)
    made = synthesize(
        pictures,
        shape.blocks,
        masks=usable,
        feature=feature,
        schedule=plan,
        boundary=boundary,
        seed=seed,
        on_step=report,
    )
    places = shape.origins(made.source_map, corners)
    moved = 0
    if cut == "mincut":
        seams = _seams(zs, space, shape)
        labels = seams.moved(places, solver, _seam_reporter(on_step, made.texture, size))
        after = space.positions.to(labels.device)[labels]
        moved, places = int((after != places).any(-1).sum()), after
    field = shape.field(places, zs)
    settings = {
        "recipe": "skeleton",
        "size": list(size),
        "made": [n * shape.side for n in shape.blocks],
        "levels": levels,
        "wavelet": wavelet,
        "phases": phases,
        "cut": cut,
        "moved": moved,
        "unused": [[n % (shape.side // phases) for n in z.shape[1:]] for z in zs],
        "coarse": made.settings,
    }
    texture = field.apply(zs)
    texture = texture if wavelet == "haar" else texture.clamp(0, 1)
    pieces = _pieces(places, shape)
    seconds = time.perf_counter() - began
    return Montage(texture, field, pieces, seconds, seed, settings)


def refine(
    made: Montage,
    exemplars: Exemplars,
    *,
    steps: int = 1,
    window: int = 8,
    boundary: Literal["free", "periodic"] = "free",
    masks: Masks = None,
    seed: int = 0,
    on_step: Callable[[Progress], None] | None = None,
) -> Result:
    """A few iterations of the optimisation at full size, from a montage: seams are averaged away.

    Args:
        made: of `skeleton`, or of another recipe.
        exemplars, boundary, masks: those that it was made with.
        steps: iterations.
        window: side of the windows.
        seed, on_step: as in `synthesize`.

    Raises:
        ValueError: as `synthesize`.

    Source: Pan et al. 2009, fig. 1, process E, "which is optional".

    Example:
        >>> exemplar = torch.rand(3, 40, 40)
        >>> refine(skeleton(exemplar, (48, 56), cut="none"), exemplar).texture.shape
        torch.Size([3, 48, 56])
    """
    h, w = made.texture.shape[1:]
    plan = (Level(1.0, window, steps),)
    done = synthesize(
        exemplars, (h, w), init=made.texture, schedule=plan, boundary=boundary, masks=masks,
        seed=seed, on_step=on_step,
    )  # fmt: skip
    settings = {**made.settings, "refined": dict(done.settings)}
    return replace(done, seconds=made.seconds + done.seconds, settings=settings)


@dataclass(frozen=True)
class _Shape:
    """Blocks, phases and margins of a run."""

    size: tuple[int, int]
    levels: int
    wavelet: str
    phases: int
    boundary: str

    @property
    def side(self) -> int:
        """Pixels of a block along each axis."""
        return 2**self.levels

    @property
    def margin(self) -> int:
        """Blocks at each side that a free border needs, so that no filter meets the far side."""
        if self.boundary == "periodic":
            return 0
        return -(-(max(reach(self.wavelet, self.levels)) - self.side + 1) // self.side)

    @property
    def blocks(self) -> tuple[int, int]:
        """Rows and columns of blocks, margin included."""
        rows, cols = (-(-n // self.side) + 2 * self.margin for n in self.size)
        return rows, cols

    def check(self, zs: Sequence[Tensor]) -> None:
        """Refuses what cannot be done."""
        height, width = self.size
        if not 1 <= self.levels <= 8:
            raise ValueError(f"levels={self.levels} must lie in 1..8")
        reach(self.wavelet, self.levels)  # refuses an unknown wavelet
        if self.boundary not in ("free", "periodic"):
            raise ValueError(f'boundary="{self.boundary}" must be "free" or "periodic"')
        check_size(self.size, memory_of(zs[0], self.size, images=8, numbers=16))
        side, phases = self.side, self.phases
        if not (1 <= phases <= side and phases & (phases - 1) == 0):
            raise ValueError(f"phases={phases} must be a power of 2, at most 2^levels={side}")
        if self.boundary == "periodic" and (height % side or width % side):
            near = "x".join(str(max(1, round(n / side)) * side) for n in self.size)
            raise ValueError(
                f"size={height}x{width} with a periodic boundary must be a multiple of "
                f"2^levels={side}; choose {near}, or fewer levels"
            )
        for what, h, w in (("exemplar", *_largest(zs)), ("size", height, width)):
            if min(h, w) < _LEAST * side:
                raise ValueError(
                    f"levels={self.levels} is too many for {what}={h}x{w}, which must be at least "
                    f"{_LEAST * side} pixels a side for windows of the coarse band; "
                    f"choose fewer levels or a larger {what}"
                )

    def places(self, zs: Sequence[Tensor], keep: Sequence[Tensor | None]) -> LabelSpace:
        """Every place of a block whose coefficients see only pixels that may be used."""
        before, after = reach(self.wavelet, self.levels)
        around = max(before, after - self.side + 1)
        clear = [None if mask is None else _eroded(mask, around) for mask in keep]
        shapes = [(z.shape[1], z.shape[2]) for z in zs]
        space = label_space(shapes, self.side, clear, device=zs[0].device)
        if not len(space):
            raise ValueError(
                f"levels={self.levels}: no block of {self.side} pixels fits into the masks; "
                "choose fewer levels or wider masks"
            )
        return space

    def coarse(self, z: Tensor) -> Tensor:
        """The approximation at every shift, in the range of the image."""
        return every_shift(z, self.wavelet, self.levels).approximation / self.side

    def exemplars(
        self, coarse: Sequence[Tensor], space: LabelSpace
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """Coarse exemplars, which of their pixels may be used, and exemplar and shift of each."""
        side, step = self.side, self.side // self.phases
        pictures, usable, corners = [], [], []
        for number, (band, table) in enumerate(zip(coarse, space.tables, strict=True)):
            h, w = (n - side + 1 for n in band.shape[1:])
            for i in range(0, side, step):
                for j in range(0, side, step):
                    picture = band[:, i:h:side, j:w:side].contiguous()
                    mask = (table[i:h:side, j:w:side] >= 0).to(band.device)
                    if picture.numel() and bool(mask.any()):
                        pictures.append(picture)
                        usable.append(mask)
                        corners.append((number, i, j))
        if not pictures:
            raise ValueError(
                f"levels={self.levels}: the masks leave no block of {self.side} pixels whole; "
                "choose fewer levels, more phases or wider masks"
            )
        return pictures, usable, torch.tensor(corners, device=coarse[0].device)

    def origins(self, sources: Int[Tensor, "y x 3"], corners: Tensor) -> Int[Tensor, "y x 3"]:
        """Where the block of each coarse pixel is from."""
        places = corners.to(sources.device)[sources[..., 0]]
        places[..., 1:] += sources[..., 1:] * self.side
        return places

    def field(self, places: Int[Tensor, "y x 3"], zs: Sequence[Tensor]) -> SourceField:
        """Where every pixel is from."""
        shapes = [(z.shape[1], z.shape[2]) for z in zs]
        if self.wavelet == "haar":
            return copied(
                block_pixels(places, self.side)[: self.size[0], : self.size[1]].contiguous(), shapes
            )
        margin = self.margin * self.side
        return band_field(places, shapes, self.size, self.wavelet, self.levels, margin)


def _plan(coarse: Tensor, shape: _Shape) -> tuple[Level, ...]:
    """The levels of the default schedule that are as coarse, or for few pixels some of our own."""
    most = min(*shape.blocks, *(n // shape.side for n in coarse.shape[1:]))
    plan = [
        replace(level, scale=level.scale * shape.side)
        for level in default_schedule()
        if level.scale * shape.side <= 1
    ]
    if shape.levels > 1:  # only levels below full scale are complete, so one is needed
        first = Level(0.5, 8 if most >= 32 else 4, 6)
        plan = [first, Level(1.0, 12, 3), Level(1.0, 8, 8)]
    picture = coarse.new_zeros(1, most, most)
    room = [level for level in roomy(plan, [picture]) if level.extent(most) >= level.size]
    return tuple(room) if room and room[-1].scale == 1 else (Level(1.0, _LEAST, 8),)


def _largest(zs: Sequence[Tensor]) -> tuple[int, int]:
    h, w = max((z.shape[1:] for z in zs), key=min)
    return h, w


def _eroded(mask: Tensor, around: int) -> Tensor:
    """True where all pixels so far around, inside the image, are."""
    if around <= 0:
        return mask
    bad = F.max_pool2d((~mask)[None].float(), 2 * around + 1, 1, around)[0]
    return bad == 0


def _pieces(places: Int[Tensor, "y x 3"], shape: _Shape) -> Int[Tensor, "h w"]:
    """Pixels that were moved together have one number."""
    which, row, col = places.unbind(-1)
    y, x = pixel_places(which.shape, places.device).unbind(-1)
    down, right = row - y * shape.side, col - x * shape.side
    if shape.boundary == "periodic":
        down, right = down % shape.size[0], right % shape.size[1]
    down, right = down - down.min(), right - right.min()
    key = (which * (down.max() + 1) + down) * (right.max() + 1) + right
    found = torch.unique(key, return_inverse=True)[1]
    pixels = found.repeat_interleave(shape.side, 0).repeat_interleave(shape.side, 1)
    first = shape.margin * shape.side
    h, w = shape.size
    return pixels[first : first + h, first : first + w].contiguous()


def _reporter(
    on_step: Callable[[Stage], None] | None, size: tuple[int, int], share: float
) -> Callable[[Progress], None] | None:
    if on_step is None:
        return None

    def report(progress: Progress) -> None:
        preview = resize(progress.texture, size).clamp(0, 1)
        on_step(Stage(share * progress.done, f"coarse {progress.note}", preview, progress.detail))

    return report


def _seam_reporter(
    on_step: Callable[[Stage], None] | None, coarse: Tensor, size: tuple[int, int]
) -> Callable[[int, float], None]:
    preview = None if on_step is None else resize(coarse, size).clamp(0, 1)

    def report(move: int, energy: float) -> None:
        if on_step is not None and preview is not None:
            done = 0.8 + 0.2 * (move + 1) / len(_STEPS)
            on_step(Stage(done, "seams", preview, f"cost {energy:.4g}"))

    return report


# ----------------------------------------------------------------------------------- seams


@dataclass(frozen=True)
class _Seams:
    """What it costs that neighboring blocks are from different pieces.

    Args:
        space: places of blocks, numbered.
        looks: of the block at each place, four parts of it.
        after: label of the place one block to the right, below, to the left, above; or -1.
        blind: cost of a pair that has nothing to be compared with.
    """

    space: LabelSpace
    shape: _Shape
    looks: Float[Tensor, "m d"]
    after: tuple[Tensor, Tensor, Tensor, Tensor]
    blind: float

    def moved(
        self,
        places: Int[Tensor, "y x 3"],
        solver: MinCut | None,
        report: Callable[[int, float], None],
    ) -> Int[Tensor, "y x"]:
        """Labels of blocks, after every piece was offered to grow over its neighbors."""
        labels = self.space.at(places).flatten()
        edges, across = self._edges(places.shape[:2], labels.device)
        first, second = labels[edges].unbind(1)
        total = float(self._pairs(first, second, across).double().sum())

        def free(labels: Tensor) -> Tensor:
            return self.looks.new_zeros(len(labels))

        for number, step in enumerate(_STEPS):
            offer = self._shifted(labels.view(places.shape[:2]), step).flatten()
            near = (offer != labels)[edges].any(1)  # all else cannot change
            if not bool(near.any()):
                continue
            nodes, ends = torch.unique(edges[near], return_inverse=True)
            count = int(near[:across].sum())
            labels[nodes], energies = expand(
                labels[nodes], offer[None, nodes], free, ends,
                lambda one, other, count=count: self._pairs(one, other, count),
                solver=solver, sweeps=1,
            )  # fmt: skip
            total += energies[-1] - energies[0]
            report(number, total)
        return labels.view(places.shape[:2])

    def _pairs(self, first: Tensor, second: Tensor, across: int) -> Tensor:
        """Of pairs of neighbors, of which the first ones lie side by side."""
        right = self._costs(first[:across], second[:across], 0)
        return torch.cat([right, self._costs(first[across:], second[across:], 1)])

    def _costs(self, first: Tensor, second: Tensor, axis: int) -> Tensor:
        """Of pairs along one axis: 0 where the second goes on where the first ends."""
        costs = self.looks.new_zeros(len(first))
        unlike = (self.after[axis][first] != second).nonzero()[:, 0]
        a, b = first[unlike], second[unlike]
        beyond, before = self.after[axis][a], self.after[axis + 2][b]
        looks = self.looks
        there = (looks[beyond.clamp(min=0)] - looks[b]).square().sum(1)
        here = (looks[before.clamp(min=0)] - looks[a]).square().sum(1)
        cost = torch.where(beyond < 0, here, there) + torch.where(before < 0, there, here)
        costs[unlike] = torch.where((beyond < 0) & (before < 0), self.blind, cost)
        return costs

    def _edges(self, size: Sequence[int], device: torch.device) -> tuple[Tensor, int]:
        """Neighbors to the right, then below, and how many the first are."""
        h, w = size
        number = torch.arange(h * w, device=device).view(h, w)
        wraps = self.shape.boundary == "periodic"
        pairs = []
        for dim in (1, 0):
            count = number.shape[dim] - (0 if wraps and number.shape[dim] > 2 else 1)
            first, second = number, number.roll(-1, dim)
            both = [x.narrow(dim, 0, count).flatten() for x in (first, second)]
            pairs.append(torch.stack(both, 1))
        return torch.cat(pairs), len(pairs[0])

    def _shifted(self, labels: Int[Tensor, "y x"], step: tuple[int, int]) -> Tensor:
        """For each block what continues the piece some blocks away; its own if that is nothing."""
        places = self.space.positions.to(labels.device)[labels]
        lines, apart = [], []
        for extent, by in zip(labels.shape, step, strict=True):
            here = torch.arange(extent, device=labels.device)
            wraps = self.shape.boundary == "periodic"
            there = (here + by) % extent if wraps else (here + by).clamp(0, extent - 1)
            lines.append(there)
            apart.append(torch.full_like(here, by) if wraps else there - here)
        found = places[lines[0][:, None], lines[1]]
        found[..., 1] -= apart[0][:, None] * self.shape.side
        found[..., 2] -= apart[1] * self.shape.side
        offer = self.space.at(found)
        return torch.where(offer < 0, labels, offer)


def _seams(zs: Sequence[Tensor], space: LabelSpace, shape: _Shape) -> _Seams:
    side, half = shape.side, shape.side // 2
    parts = []
    for z, table in zip(zs, space.tables, strict=True):
        mean = F.avg_pool2d(z[None], half, 1)[0]
        h, w = z.shape[1] - side + 1, z.shape[2] - side + 1
        corners = [(i, j) for i in (0, half) for j in (0, half)]
        block = torch.cat([mean[:, i : i + h, j : j + w] for i, j in corners])
        parts.append(block[:, table[:h, :w] >= 0].T * half)
    looks = torch.cat(parts)
    directions = ((0, 0, side), (0, side, 0), (0, 0, -side), (0, -side, 0))
    place = space.positions
    right, down, left, up = (space.at(place + place.new_tensor(by)) for by in directions)
    blind = 4 * float(looks.var(0, correction=0).sum()) + 1e-6
    return _Seams(space, shape, looks, (right, down, left, up), blind)
