"""Holes in a photo, filled from its own texture.

Two steps for each hole. The EM solver makes a texture of the hole's surroundings, where the known
pixels are a soft constraint and are put back after every E-step. Its labels are proposals: each of
the offsets (source less place) that it chose most often is offered to all pixels of the hole, and
min-cuts decide who takes it, so that neighbors from unlike offsets agree where they meet, above all
at the border of the hole. Every new pixel is thus a copy of a known one, as sharp as the photo. A
Poisson solve within the hole evens out what difference of level is left.

Source: Kwatra et al. 2005, eq. 2 (soft constraints), 2003 (cost of a seam); the energy of offsets
after Pritch et al. 2009, frequent offsets as its labels after He and Sun 2012; Perez et al. 2003.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchtex.controls import SoftConstraint
from torchtex.cuts.expansion import Move, expand
from torchtex.cuts.laplace import bounding_box
from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.cuts.poisson import Guidance, solve
from torchtex.energy import Objective
from torchtex.estep import Auto
from torchtex.features import Feature
from torchtex.image import resize
from torchtex.inputs import check_exemplars, check_not_negative, check_seed
from torchtex.model import Search, label_space
from torchtex.neighborhoods import Grid
from torchtex.recipes.montage import Montage, Stage
from torchtex.result import Progress
from torchtex.schedule import Level, default_schedule
from torchtex.sources import copied, pixel_places
from torchtex.starts import Blocks
from torchtex.synthesize import synthesize

Box = tuple[slice, slice]

_SWEEPS = 3
_NEAR = 6  # pixels around one that say how flat an image is there
_UNSEEN = 2.0  # cost of a seam where neither side has a known pixel to compare


def fill(
    image: Float[Tensor, "c h w"],
    mask: Bool[Tensor, "_ _"],
    *,
    feature: Feature | None = None,
    r: float = 0.8,
    confidence: float = 10.0,
    offsets: int = 64,
    border: float = 10.0,
    detail: float = 0.05,
    poisson: bool = True,
    reach: int = 256,
    schedule: Sequence[Level] | None = None,
    search: Search | None = None,
    solver: MinCut | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """Fills holes from the rest of the image, coherent with what is around them.

    Known pixels keep their bits. What the holes hold now changes nothing; it may be NaN.
    `result.apply(image)` equals the texture where poisson=False, and `apply` of an aligned map
    fills that map in the same way. `result.patches` is 0 for known pixels, and one number for
    all pixels of one offset in one hole.

    Args:
        image: (c, h, w) in [0, 1].
        mask: True in the holes; of any shape, also at the border of the image.
        feature, r, schedule, search: of the EM solver, see `synthesize`.
        confidence: of the known pixels against the texture energy.
        offsets: how many are offered, half of them from the rim of the hole.
        border: cost of a seam at the border of a hole, against 1 for one inside.
        detail: cost of a pixel from where the image is flatter than around the hole, which seams
            alone would prefer; in proportion to how much flatter.
        poisson: even out the levels along the seams.
        reach: pixels around a hole that are searched for its texture.
        solver: of the min-cuts; the first one that is installed unless given.
        seed: same seed, same machine: same bits.
        on_step: called after each step; raise from it to cancel.

    Raises:
        ValueError: a mask that is empty or full, of another size, or leaves no whole window;
            or an option out of range.

    Example:
        >>> from torchtex import data
        >>> photo = data.load("gravel")[:, :64, :64]
        >>> hole = torch.zeros(64, 64, dtype=torch.bool)
        >>> hole[24:40, 20:44] = True
        >>> result = fill(photo, hole)
        >>> torch.equal(result.texture[:, ~hole], photo[:, ~hole])
        True
    """
    began = time.perf_counter()
    _check(
        image,
        mask,
        {"confidence": confidence, "border": border, "detail": detail},
        offsets,
        reach,
        seed,
    )
    levels = tuple(default_schedule() if schedule is None else schedule)
    least = min(level.size for level in levels)
    if not len(label_space([(mask.shape[0], mask.shape[1])], least, [~mask])):
        raise ValueError(
            f"mask leaves no whole window of {least}x{least} known pixels; "
            "make the hole smaller or choose a schedule with smaller windows"
        )
    solver = default_solver() if solver is None else solver
    known = ~mask
    whole = torch.where(known, image.detach(), image[:, known].mean(1)[:, None, None])
    sources, patches = (
        pixel_places(mask.shape, mask.device),
        torch.zeros_like(mask, dtype=torch.long),
    )
    margin = max(round(level.size / level.scale) for level in levels)
    boxes = _boxes(mask, margin)
    areas = [int(mask[box].sum()) for box in boxes]
    for number, box in enumerate(boxes):
        near, wide = _around(box, margin, reach, known, least)
        target = torch.zeros_like(mask)
        target[box] = mask[box]
        before, share = sum(areas[:number]) / sum(areas), areas[number] / sum(areas)
        watch = _Watch(on_step, whole, near, target, before, share)
        part = _Part(whole[:, wide[0], wide[1]], known[wide], target[wide])
        held = SoftConstraint(whole[:, near[0], near[1]], known[near].to(whole))
        result = synthesize(
            part.image,
            (held.target.shape[1], held.target.shape[2]),
            masks=part.known,
            feature=feature,
            r=r,
            start=KeptStart(Kept(held)),
            schedule=schedule,
            search=search,
            estep=Kept(held),
            controls=[(confidence, held)],
            seed=seed,
            on_step=watch.solved,
        )
        proposed = pixel_places(part.known.shape, mask.device)
        proposed[_shifted(near, -wide[0].start, -wide[1].start)] = result.source_map[..., 1:]
        proposed[part.known] = pixel_places(part.known.shape, mask.device)[part.known]
        offered = part.offered(proposed, offsets)
        places = part.cut(
            proposed, offered, border, detail, solver, watch.cut(_SWEEPS * len(offered))
        )
        filled = part.pixels(places, poisson=poisson)
        whole[:, wide[0], wide[1]] = torch.where(part.target, filled, part.image)
        corner = torch.tensor([wide[0].start, wide[1].start], device=places.device)
        sources[wide][part.target] = places[part.target] + corner
        moved = (places - pixel_places(part.known.shape, mask.device))[part.target]
        which = moved.unique(dim=0, return_inverse=True)[1]
        patches[wide][part.target] = which + int(patches.max()) + 1
    settings = {
        "recipe": "fill", "pixels": sum(areas), "holes": len(boxes), "feature": repr(feature),
        "r": r, "confidence": confidence, "offsets": offsets, "border": border, "detail": detail,
        "poisson": poisson, "reach": reach,
        "schedule": [[level.scale, level.size, level.steps] for level in levels],
    }  # fmt: skip
    field = copied(F.pad(sources, (1, 0)), [(mask.shape[0], mask.shape[1])])
    return Montage(whole, field, patches, time.perf_counter() - began, seed, settings)


@dataclass(frozen=True)
class Kept:
    """An E-step that puts known pixels back.

    Args:
        known: the pixels, with confidence 1 where they are known and 0 elsewhere.

    Example:
        >>> kept = Kept(SoftConstraint(torch.ones(1, 8, 8), torch.eye(8)))
        >>> kept.put(torch.zeros(1, 8, 8)).sum().item()
        8.0
    """

    known: SoftConstraint

    def put(self, x: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        """The pixels with the known ones in their places, at any size."""
        given = self.known
        if given.target.shape != x.shape:
            given = given.at(x.shape[1], x.shape[2])
        return torch.where(given.confidence > 0.95, given.target, x)

    def __call__(self, objective: Objective, x: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        return self.put(Auto()(objective, x))


@dataclass(frozen=True)
class KeptStart:
    """Random blocks around known pixels, or in their hole.

    Args:
        kept: the known pixels.

    Example:
        >>> start = KeptStart(Kept(SoftConstraint(torch.ones(1, 8, 8), torch.ones(8, 8))))
        >>> x = start([torch.zeros(1, 8, 8)], [None], Grid(8, 8, 8, 8), torch.Generator())
        >>> x.min().item()
        1.0
    """

    kept: Kept

    def __call__(
        self,
        exemplars: Sequence[Tensor],
        masks: Sequence[Tensor | None],
        grid: Grid,
        generator: torch.Generator,
    ) -> Float[Tensor, "c h w"]:
        return self.kept.put(Blocks()(exemplars, masks, grid, generator))


@dataclass(frozen=True)
class _Part:
    """A hole and what surrounds it. A place is a pixel of it; a label is its number, row by row."""

    image: Float[Tensor, "c h w"]
    known: Bool[Tensor, "h w"]
    target: Bool[Tensor, "h w"]

    def offered(self, proposed: Int[Tensor, "h w 2"], count: int) -> Int[Tensor, "k 2"]:
        """The offsets that are most frequent in the hole, and those at its rim."""
        moved = proposed - pixel_places(self.known.shape, proposed.device)
        rim = self.target & (F.max_pool2d((~self.target)[None].float(), 13, 1, 6)[0] > 0)
        return torch.cat([_frequent(moved[self.target], count - count // 2),
                          _frequent(moved[rim], count // 2)]).unique(dim=0)  # fmt: skip

    def cut(
        self,
        proposed: Int[Tensor, "h w 2"],
        offered: Int[Tensor, "k 2"],
        border: float,
        detail: float,
        solver: MinCut,
        on_step: Callable[[Move], None] | None,
    ) -> Int[Tensor, "h w 2"]:
        """Places that agree with their neighbors, of the proposed and the offered ones."""
        h, w = self.known.shape
        nodes = F.max_pool2d(self.target[None].float(), 3, 1, 1)[0] > 0  # the hole and its ring
        here = nodes.nonzero()
        fixed, own = ~self.target[nodes], _flat(here, w)
        usable = self.known.flatten()
        begin = torch.where(fixed, own, _flat(proposed, w)[nodes])
        rows = []
        for offset in offered:
            place = here + offset
            exists = ((place >= 0) & (place < place.new_tensor([h, w]))).all(1) & ~fixed
            label = torch.where(exists, _flat(place, w), begin)
            rows.append(torch.where(usable[label], label, begin))

        flat = detail * self.flatness().flatten()

        def unary(labels: Tensor) -> Tensor:
            barred = torch.where(fixed, labels != own, ~usable[labels])
            return torch.where(fixed, 0, flat[labels]).masked_fill(barred, torch.inf)

        number = torch.full((h, w), -1, device=here.device)
        number[nodes] = torch.arange(len(here), device=here.device)
        pairs = [torch.stack(_ends(number, axis), -1).view(-1, 2) for axis in (1, 0)]
        pairs = [p[(p >= 0).all(1) & ~fixed[p].all(1)] for p in pairs]
        edges = torch.cat(pairs)
        weight = torch.where(fixed[edges].any(1), border, 1.0).to(self.image)
        split = len(pairs[0])
        views = self._views()

        def pairwise(first: Tensor, second: Tensor) -> Tensor:
            costs = torch.cat([
                _seam(views, first[:split], second[:split], 1),
                _seam(views, first[split:], second[split:], 2),
            ])  # fmt: skip
            step = torch.ones_like(first)
            step[split:] = w
            together = (second - first == step) & ((step == w) | (second % w > 0))
            return (weight * costs).masked_fill(together, 0)

        labels, _ = expand(
            begin, torch.stack(rows), unary, edges, pairwise,
            solver=solver, sweeps=_SWEEPS, on_step=on_step,
        )  # fmt: skip
        places = pixel_places(self.known.shape, here.device)
        places[nodes] = torch.stack([labels // w, labels % w], 1)
        return places

    def flatness(self) -> Float[Tensor, "h w"]:
        """How much less than around the hole an image changes from pixel to pixel, 0 to 1."""
        steps, counts = torch.zeros_like(self.image[0]), torch.zeros_like(self.image[0])
        for axis in (0, 1):
            one, other = _ends(self.known, axis)
            both = (one & other).to(self.image)
            step = self.image.diff(dim=axis + 1).square().sum(0).sqrt() * both
            steps.narrow(axis, 0, step.shape[axis]).add_(step)
            counts.narrow(axis, 0, step.shape[axis]).add_(both)
        wide = 2 * _NEAR + 1
        local, count = (
            F.avg_pool2d(x[None, None], wide, 1, _NEAR, count_include_pad=True)[0, 0]
            for x in (steps, counts)
        )
        local = local / count.clamp(min=1e-6)
        rim = self.known & (F.max_pool2d(self.target[None].to(local), 2 * wide + 1, 1, wide)[0] > 0)
        usual = local[rim if bool(rim.any()) else self.known].mean()
        return (1 - local / usual.clamp(min=1e-6)).clamp(0, 1)

    def pixels(
        self, places: Int[Tensor, "h w 2"], *, poisson: bool = False
    ) -> Float[Tensor, "c h w"]:
        """The pixels of those places; with `poisson`, levelled along the seams."""
        pasted = self.image[:, places[..., 0], places[..., 1]]
        if not poisson:
            return pasted
        labels, views = _flat(places, self.known.shape[1]), self._views()
        right, down = (_slope(views, *_ends(labels, axis), view) for axis, view in ((1, 1), (0, 2)))
        return solve(Guidance(right, down), pasted, self.target, boundary="free").clamp(0, 1)

    def _views(self) -> Float[Tensor, "5 k n"]:
        """Channels and 1 where known: at a pixel, and to its right, below, left and above it."""
        full = torch.cat([self.image, self.known[None].to(self.image)])
        wide = F.pad(full, (1, 1, 1, 1))
        h, w = self.known.shape
        steps = ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0))
        return torch.stack([wide[:, 1 + i : 1 + i + h, 1 + j : 1 + j + w] for i, j in steps]).view(
            5, len(full), h * w
        )


def _seam(views: Tensor, one: Tensor, other: Tensor, view: int) -> Tensor:
    """How unlike both labels are at both pixels of an edge, as far as pixels are known."""
    gaps = counts = torch.zeros_like(views[0, 0, one])
    for a, b in (
        (views[0][:, one], views[view + 2][:, other]),
        (views[view][:, one], views[0][:, other]),
    ):
        both = a[-1] * b[-1]
        gaps = gaps + both * (a[:-1] - b[:-1]).square().sum(0).sqrt()
        counts = counts + both
    return torch.where(counts > 0, 2 * gaps / counts.clamp(min=1), _UNSEEN)


def _slope(views: Tensor, one: Tensor, other: Tensor, view: int) -> Tensor:
    """Wanted difference along each edge: the mean of those at both sources, where known."""
    here, after = views[0][:, one], views[view][:, one]
    before, there = views[view + 2][:, other], views[0][:, other]
    first, second = here[-1] * after[-1], before[-1] * there[-1]
    slope = first * (after - here)[:-1] + second * (there - before)[:-1]
    return slope / (first + second).clamp(min=1)


def _frequent(moved: Int[Tensor, "n 2"], count: int) -> Int[Tensor, "k 2"]:
    kinds, times = moved.unique(dim=0, return_counts=True)
    return kinds[times.argsort(descending=True, stable=True)[:count]]


def _flat(places: Int[Tensor, "*n 2"], width: int) -> Int[Tensor, "*n"]:
    return places[..., 0] * width + places[..., 1]


def _ends(x: Shaped[Tensor, "h w"], axis: int) -> tuple[Tensor, Tensor]:
    """The two ends of all edges along an axis."""
    n = x.shape[axis]
    return x.narrow(axis, 0, n - 1), x.narrow(axis, 1, n - 1)


def _boxes(mask: Bool[Tensor, "h w"], gap: int) -> list[Box]:
    """Boxes that hold all of the mask, split where more than `gap` rows or columns are free."""
    found: list[Box] = []
    todo = [bounding_box(mask)]
    while todo:
        box = todo.pop()
        for axis in (0, 1):
            taken = mask[box].any(1 - axis).nonzero().flatten()
            free = (taken.diff() > gap).nonzero().flatten()
            if len(free):
                middle = box[axis].start + int(taken[free[0]]) + 1
                for span in (slice(box[axis].start, middle), slice(middle, box[axis].stop)):
                    half = (span, box[1]) if axis == 0 else (box[0], span)
                    tight = bounding_box(mask[half])
                    todo.append(_shifted(tight, half[0].start, half[1].start))
                break
        else:
            found.append(box)
    return sorted(found, key=lambda box: (box[0].start, box[1].start))


def _around(
    box: Box, margin: int, reach: int, known: Bool[Tensor, "h w"], least: int
) -> tuple[Box, Box]:
    """What the solver makes, and where it may look; all of the image if that holds no window."""
    near, wide = (_grown(box, by, known.shape) for by in (margin, max(margin, reach)))
    if not len(label_space([(known[wide].shape[0], known[wide].shape[1])], least, [known[wide]])):
        wide = (slice(0, known.shape[0]), slice(0, known.shape[1]))
    return near, wide


def _grown(box: Box, by: int, size: Sequence[int]) -> Box:
    rows, cols = (
        slice(max(0, s.start - by), min(n, s.stop + by)) for s, n in zip(box, size, strict=True)
    )
    return rows, cols


def _shifted(box: Box, rows: int, cols: int) -> Box:
    return (
        slice(box[0].start + rows, box[0].stop + rows),
        slice(box[1].start + cols, box[1].stop + cols),
    )


@dataclass(frozen=True)
class _Watch:
    """Tells `on_step` of the two steps of one hole."""

    tell: Callable[[Stage], None] | None
    whole: Float[Tensor, "c h w"]
    near: Box
    target: Bool[Tensor, "h w"]
    before: float
    share: float

    @property
    def solved(self) -> Callable[[Progress], None] | None:
        if self.tell is None:
            return None
        tell = self.tell

        def report(progress: Progress) -> None:
            preview = self.whole.clone()
            rows, cols = self.near
            size = (rows.stop - rows.start, cols.stop - cols.start)
            preview[:, rows, cols] = resize(progress.texture, size).clamp(0, 1)
            preview = torch.where(self.target, preview, self.whole)
            done = self.before + 0.5 * self.share * progress.done
            tell(Stage(done, progress.note, preview, progress.detail))

        return report

    def cut(self, moves: int) -> Callable[[Move], None] | None:
        if self.tell is None:
            return None
        tell, count = self.tell, 0

        def report(move: Move) -> None:
            nonlocal count
            count += 1
            done = self.before + self.share * (0.5 + 0.5 * count / moves)
            tell(Stage(done, "min-cuts", self.whole, f"energy {move.energy:.4g}"))

        return report


def _check(
    image: Tensor, mask: Tensor, costs: Mapping[str, float], offsets: int, reach: int, seed: int
) -> None:
    if mask.shape != image.shape[1:]:
        raise ValueError(
            f"mask is {mask.shape[0]}x{mask.shape[1]} and image {image.shape[1]}x"
            f"{image.shape[2]}; give a mask of the size of the image"
        )
    if bool(mask.all()) or not bool(mask.any()):
        state = "nowhere" if not bool(mask.any()) else "everywhere"
        raise ValueError(
            f"mask is True {state}; mark the holes, and leave pixels to fill them from"
        )
    check_exemplars([torch.where(mask, 0, image)])
    check_seed(seed)
    for name, cost in costs.items():
        check_not_negative(name, cost)
    for name, value in (("offsets", offsets), ("reach", reach)):
        if value < 1:
            raise ValueError(f"{name}={value} must be at least 1")
