"""Graphcut textures: the whole exemplar laid over the texture again and again, cut in by min-cut.

First the canvas is filled, row by row. Then *refinement* lays the exemplar over the places whose
seams are worst: the cut takes the older seams into account, so their total never rises.

Source: Kwatra et al. 2003, Graphcut textures: image and video synthesis using graph cuts.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.cuts.poisson import Guidance, solve
from torchtex.cuts.seams import cut_patch, patch_views, present_seams
from torchtex.inputs import (
    Exemplars,
    Masks,
    check_not_negative,
    check_seed,
    check_size,
    memory_of,
    usable_exemplars,
)
from torchtex.patches import SsdSearch, box_sums, ssd_canvas, ssd_search, summed_area
from torchtex.picks import pick_soft
from torchtex.quadratic import threads
from torchtex.recipes.montage import Montage, Stage
from torchtex.sources import copied

LOOKS = 3  # variants of the exemplars that are tried for one placement
MARGIN = 4  # a new patch overlaps what is there by 1 / MARGIN of its side
NEAR = 2  # translations so near to a present one, in pixels, bring nothing new


@dataclass(frozen=True)
class Random:
    """Patches go anywhere; the cut alone makes them fit.

    Example:
        >>> Random()
        Random()
    """


@dataclass(frozen=True)
class EntirePatch:
    """The whole exemplar is compared with all that it covers.

    Args:
        k: a translation of cost C per pixel is drawn with probability exp(-C / (k sigma^2)),
            where sigma^2 is the variance of the exemplar: small is strict.
        spread: C grows by this share for every time that the part of the exemplar which comes to
            the place is shown already, more or less than others: parts take turns, and fewer
            repetitions are seen. 0 for the paper's costs.

    Example:
        >>> EntirePatch(k=0.1).spread
        0.3
    """

    k: float = 0.01
    spread: float = 0.3

    def __post_init__(self) -> None:
        _check_draw(self.k, self.spread)


@dataclass(frozen=True)
class SubPatch:
    """A square around the place to be filled or mended is looked for in the exemplar.

    Args:
        patch: side of the square in pixels; None for a third of the least side of the exemplars.
        k, spread: as of `EntirePatch`.

    Example:
        >>> SubPatch(patch=24).patch
        24
    """

    patch: int | None = None
    k: float = 0.01
    spread: float = 0.3

    def __post_init__(self) -> None:
        _check_draw(self.k, self.spread)
        if self.patch is not None and self.patch < 1:
            raise ValueError(f"patch={self.patch} must be at least 1 pixel")


Placement = Random | EntirePatch | SubPatch


@dataclass(frozen=True)
class _Piece:
    """An exemplar, perhaps turned, mirrored or scaled, that patches are cut from."""

    image: Float[Tensor, "c h w"]
    views: Float[Tensor, "5 c h w"]
    positions: Tensor
    places: Int[Tensor, "h w"]  # the same as one number, of the nearest pixel of all exemplars
    usable: Bool[Tensor, "h w"]
    search: SsdSearch
    variance: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.image.shape[1], self.image.shape[2]


@dataclass(frozen=True)
class _Spots:
    """Costs of translations of a piece; entry (0, 0) puts its first pixel at (top, left)."""

    piece: int
    top: int
    left: int
    costs: Float[Tensor, "rows cols"]

    def brought(self, piece: _Piece, row: int, col: int) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Index of the pixels that the translations bring to a place, and which there are."""
        device = self.costs.device
        rows = row - self.top - torch.arange(self.costs.shape[0], device=device)
        cols = col - self.left - torch.arange(self.costs.shape[1], device=device)
        h, w = piece.shape
        inside = ((rows >= 0) & (rows < h))[:, None] & (cols >= 0) & (cols < w)
        return (rows.clamp(0, h - 1)[:, None], cols.clamp(0, w - 1)), inside


@dataclass
class _Canvas:
    """What is there: views, the source and the patch of every pixel, and the cost of its seams."""

    views: Float[Tensor, "5 c h w"]
    filled: Bool[Tensor, "h w"]
    positions: Tensor
    places: Int[Tensor, "h w"]
    patches: Int[Tensor, "h w"]
    seams: Float[Tensor, "h w"]
    periodic: bool
    placed: list[tuple[int, int, int]] = field(default_factory=list)

    @property
    def shape(self) -> tuple[int, int]:
        return self.filled.shape[0], self.filled.shape[1]

    def part(self, top: int, left: int, bottom: int, right: int) -> tuple[Any, Tensor]:
        """Index of a rectangle, which may leave the canvas, and where it is inside."""
        lines, inside = [], []
        for start, stop, extent in zip((top, left), (bottom, right), self.shape, strict=True):
            line = torch.arange(start, stop, device=self.filled.device)
            inside.append((line >= 0) & (line < extent) | self.periodic)
            lines.append(line % extent if self.periodic else line.clamp(0, extent - 1))
        return (lines[0][:, None], lines[1]), inside[0][:, None] & inside[1]

    def paste(
        self, piece: _Piece, number: int, at: tuple[int, int], box: tuple[int, int, int, int],
        cut: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor], gradient: bool,
    ) -> bool:  # fmt: skip
        """Cuts a piece in, in a box of the canvas; False where that would not lower the seams."""
        top, left, bottom, right = box
        index, inside = self.part(top - 1, left - 1, bottom + 1, right + 1)
        known = self.filled[index] & inside
        own = (slice(top - at[0], bottom - at[0]), slice(left - at[1], right - at[1]))
        usable = piece.usable[own]
        held = known & ~pad(usable, (1, 1, 1, 1))
        beside = held[2:, 1:-1] | held[:-2, 1:-1] | held[1:-1, 2:] | held[1:-1, :-2]
        index = (index[0][1:-1], index[1][1:-1])
        known = known[1:-1, 1:-1]
        empty = usable & ~known
        new = piece.views[..., own[0], own[1]]
        old = self.views[..., index[0], index[1]]
        # what stays empty makes no seam
        old = torch.where(known, old, new)
        labels = empty
        if bool(known.any()):
            labels = cut(old, new, ~usable | (known & beside), empty)
        if not bool(labels.any()):
            return False
        mixed = torch.where(labels, new, old)
        if not bool(empty.any()) and not _total(mixed, gradient) < _total(old, gradient):
            return False
        self.views[..., index[0], index[1]] = mixed
        self.filled[index] |= labels
        source = piece.positions[own]
        self.positions[index] = torch.where(labels[..., None], source, self.positions[index])
        self.places[index] = torch.where(labels, piece.places[own], self.places[index])
        self.patches[index] = torch.where(labels, len(self.placed), self.patches[index])
        self.placed.append((number, *at))
        self._count(box, gradient)
        return True

    def _count(self, box: tuple[int, int, int, int], gradient: bool) -> None:
        """Costs of the seams to the right of and below every pixel in and around a box."""
        top, left, bottom, right = box
        index, inside = self.part(top - 1, left - 1, bottom + 1, right + 1)
        known = self.filled[index] & inside
        across, down = present_seams(self.views[..., index[0], index[1]], gradient=gradient)
        costs = torch.where(known[:, 1:] & known[:, :-1], across, 0)[:-1]
        costs = costs + torch.where(known[1:] & known[:-1], down, 0)[:, :-1]
        inside = inside[:-1, :-1]
        index = (index[0][:-1].expand_as(inside)[inside], index[1][:-1].expand_as(inside)[inside])
        self.seams[index] = costs[inside]


def graphcut(
    exemplars: Exemplars,
    size: tuple[int, int],
    *,
    placement: Placement | None = None,
    gradient: bool = True,
    refine: int | None = None,
    turns: bool = False,
    mirrors: bool = False,
    scales: Sequence[float] = (1.0,),
    poisson: bool = False,
    boundary: Literal["free", "periodic"] = "free",
    masks: Masks = None,
    solver: MinCut | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """A texture of overlapping copies of the exemplars, joined along seams of least cost.

    Args:
        exemplars: one image, or several with equal channels.
        size: (height, width) of the texture.
        placement: where patches go; None for `SubPatch()`, which repeats itself less than
            `EntirePatch()` does and has seams as good; that one keeps weaves straighter.
        gradient: seams cost less along edges of the picture, where they are hardly seen.
        refine: placements over the worst seams, after the canvas is full; None for as many as
            suit its size.
        turns: also patches turned by 90, 180 and 270 degrees.
        mirrors: also patches seen in a mirror.
        scales: also patches enlarged or reduced so; resampled bilinearly from the exemplar.
        poisson: at the end, find pixels anew from their differences, so that steps of brightness
            at seams vanish; `apply` of the result does not do that.
        boundary: "periodic" for a texture that tiles.
        masks: True where an exemplar may be used; one per exemplar.
        solver: of the min-cuts; None for the first one that is installed.
        seed: same seed, same bits.
        on_step: called after every placement; may raise to cancel.

    Returns:
        A montage; its settings hold the cost of all seams before and after refinement.

    Raises:
        ValueError: an option out of range, or exemplars that differ in kind.
        ImportError: no min-cut solver is installed.

    Source: Kwatra et al. 2003, sections 3 to 5; `spread` is ours.

    Example:
        >>> result = graphcut(torch.rand(3, 24, 24), (32, 40), refine=2)
        >>> result.texture.shape
        torch.Size([3, 32, 40])
    """
    started = time.perf_counter()
    zs, keep = usable_exemplars(exemplars, masks)
    placement = SubPatch() if placement is None else placement
    check_size(size, memory_of(zs[0], size, images=9, numbers=10))
    check_seed(seed)
    _check_options(refine, scales, boundary)
    solver = default_solver() if solver is None else solver
    with threads(1):  # the pieces are small
        pieces = _pieces(zs, keep, turns, mirrors, scales)
        if isinstance(placement, SubPatch):
            placement = _fitted(placement, pieces, size)
        run = _Run(
            pieces, _canvas(pieces, size, boundary == "periodic"), placement, gradient, solver,
            torch.Generator().manual_seed(seed), on_step,
            sum(z.shape[1] * z.shape[2] for z in zs),
        )  # fmt: skip
        count = run.suitable() if refine is None else refine
        run.fill(0.5 if count else 1.0)
        before = float(run.canvas.seams.double().sum())
        run.refine(count)
        after = float(run.canvas.seams.double().sum())
        made = copied(run.canvas.positions, [(z.shape[1], z.shape[2]) for z in zs])
        texture = made.apply(zs)
        if poisson:
            texture = _solved(run.canvas, texture)
    settings = {
        "recipe": "graphcut",
        "placement": type(placement).__name__, **asdict(placement),
        "gradient": gradient, "refine": count, "turns": turns, "mirrors": mirrors,
        "scales": list(scales), "poisson": poisson, "boundary": boundary,
        "solver": type(solver).__name__,
        "seam_cost_before_refinement": before, "seam_cost": after,
    }  # fmt: skip
    patches = torch.unique(run.canvas.patches, return_inverse=True)[1]
    return Montage(texture, made, patches, time.perf_counter() - started, seed, settings)


@dataclass
class _Run:
    pieces: list[_Piece]
    canvas: _Canvas
    placement: Placement
    gradient: bool
    solver: MinCut
    generator: torch.Generator
    on_step: Callable[[Stage], None] | None
    exemplars: int  # pixels of all of them

    def suitable(self) -> int:
        """Placements of refinement that a canvas of this size asks for."""
        area = sum(h * w for h, w in (p.shape for p in self.pieces)) / len(self.pieces)
        return min(400, round(10 * self.canvas.filled.numel() / area))

    def fill(self, share: float) -> None:
        """Places patches, each over the first pixel that is empty, until none is."""
        h, w = self.canvas.shape
        while True:
            empty = (~self.canvas.filled).flatten().nonzero()
            if not len(empty):
                return
            row, col = divmod(int(empty[0]), w)
            found = [self._growing(number, row, col) for number in self._drawn()]
            self._place(found, row, col, (3 * h // 8, 3 * w // 8))
            self._tell(share * (1 - len(empty) / (h * w)), "filling")

    def refine(self, count: int) -> None:
        """Lays patches over the worst seams, and keeps what makes them better."""
        canvas, (h, w) = self.canvas, self.canvas.shape
        weight = torch.ones_like(canvas.seams)
        side = max(1, min(h, w, min(min(p.shape) for p in self.pieces) // MARGIN))
        for step in range(count):
            heat = box_sums(summed_area(canvas.seams * weight), side, side)
            worst = int(heat.argmax())
            if not float(heat.flatten()[worst]) > 0:
                return
            top, left = divmod(worst, heat.shape[1])
            # the next search is elsewhere, unless this remains by far the worst
            weight[top : top + side, left : left + side] *= 0.5
            row, col = top + side // 2, left + side // 2
            found = [self._covering(n, row, col, side) for n in self._drawn()]
            self._place(found, row, col, (h, w))
            self._tell(0.5 + 0.5 * (step + 1) / count, "refining")

    def _drawn(self) -> list[int]:
        order = torch.randperm(len(self.pieces), generator=self.generator)
        return [int(i) for i in order[:LOOKS]]

    def _place(self, found: list[_Spots], row: int, col: int, reach: tuple[int, int]) -> None:
        costs = torch.cat([spots.costs.flatten() for spots in found])[None]
        if not bool(costs.isfinite().any()):
            return
        k = getattr(self.placement, "k", 1.0)
        variance = sum(p.variance for p in self.pieces) / len(self.pieces)
        _, chosen = pick_soft(costs, max(k * variance, 1e-12), self.generator)
        for spots in found:
            if chosen < spots.costs.numel():
                break
            chosen -= spots.costs.numel()
        down, across = divmod(chosen, spots.costs.shape[1])
        piece, at = self.pieces[spots.piece], (spots.top + down, spots.left + across)
        (h, w), (height, width) = self.canvas.shape, piece.shape
        low, high = (at[0], at[1]), (at[0] + height, at[1] + width)
        if self.canvas.periodic:  # a patch must not meet itself
            ends = (3 * h // 8, 3 * w // 8)
            low = (max(low[0], row - ends[0]), max(low[1], col - ends[1]))
            high = (min(high[0], row + ends[0] + 1), min(high[1], col + ends[1] + 1))
        else:
            low, high = (max(low[0], 0), max(low[1], 0)), (min(high[0], h), min(high[1], w))

        def cut(old: Tensor, new: Tensor, first: Tensor, second: Tensor) -> Tensor:
            return cut_patch(old, new, first, second, gradient=self.gradient, solver=self.solver)

        self.canvas.paste(piece, spots.piece, at, (*low, *high), cut, self.gradient)

    def _growing(self, number: int, row: int, col: int) -> _Spots:
        """Translations that cover an empty pixel, and much besides that is empty."""
        piece = self.pieces[number]
        spots = self._spread(self._compared(number, row, col, 1), row, col)
        top, left, (rows, cols) = spots.top, spots.left, spots.costs.shape
        h, w = piece.shape
        index, inside = self.canvas.part(top, left, top + rows + h - 1, left + cols + w - 1)
        empty = (~self.canvas.filled[index] & inside).to(spots.costs)
        gain = box_sums(summed_area(empty), h, w)
        covers = self._covers(piece, spots, row, col)
        gain = torch.where(covers, gain, 0)
        costs = torch.where(covers & (gain >= gain.max() / 2), spots.costs, torch.inf)
        if not bool(costs.isfinite().any()):  # masks left none that overlaps
            costs = torch.where(covers, 0.0, torch.inf).to(spots.costs)
        return _Spots(number, top, left, costs)

    def _covering(self, number: int, row: int, col: int, side: int) -> _Spots:
        """Translations that cover a bad place, but for those that are present near it."""
        spots = self._spread(self._compared(number, row, col, side), row, col)
        covers = self._covers(self.pieces[number], spots, row, col)
        costs = torch.where(covers, spots.costs, torch.inf)
        for other, top, left in self.canvas.placed:
            if other == number:
                i, j = top - spots.top, left - spots.left
                costs[
                    max(i - NEAR, 0) : max(i + NEAR + 1, 0), max(j - NEAR, 0) : max(j + NEAR + 1, 0)
                ] = torch.inf
        return _Spots(number, spots.top, spots.left, costs)

    def _covers(self, piece: _Piece, spots: _Spots, row: int, col: int) -> Bool[Tensor, "r c"]:
        """Translations that bring a usable pixel to a place."""
        index, inside = spots.brought(piece, row, col)
        return inside & piece.usable[index]

    def _spread(self, spots: _Spots, row: int, col: int) -> _Spots:
        """Higher costs for what the canvas shows more often than other parts."""
        canvas, piece = self.canvas, self.pieces[spots.piece]
        share = 0.0 if isinstance(self.placement, Random) else self.placement.spread
        if share == 0 or not canvas.placed:
            return spots
        shown = canvas.places[canvas.filled]
        count = torch.bincount(shown, minlength=self.exemplars)[piece.places].to(spots.costs)
        side = min(piece.shape) // 8 | 1
        around = avg_pool2d(count[None], side, 1, side // 2, count_include_pad=False)[0]
        around = around * (self.exemplars / len(shown))
        costs = spots.costs * (1 + share * around[spots.brought(piece, row, col)[0]])
        return replace(spots, costs=costs)

    def _compared(self, number: int, row: int, col: int, side: int) -> _Spots:
        """Costs per pixel of the translations of a piece over a place."""
        piece, canvas = self.pieces[number], self.canvas
        (h, w), (hz, wz) = canvas.shape, piece.shape
        if isinstance(self.placement, SubPatch):
            extent = self.placement.patch
            assert extent is not None
            top, left = row - extent // 2, col - extent // 2
            if not canvas.periodic:
                top, left = min(max(top, 0), h - extent), min(max(left, 0), w - extent)
            index, _ = canvas.part(top, left, top + extent, left + extent)
            known = canvas.filled[index]
            if bool(known.any()):
                costs = piece.search(canvas.views[0][:, index[0], index[1]][None], known)[0]
                costs = costs.flip(0, 1) / known.sum()
                return _Spots(number, top - hz + extent, left - wz + extent, costs)
        low, high = zip(_reach(row, hz, side), _reach(col, wz, side), strict=True)
        rows, cols = max(high[0] - low[0], 0) + 1, max(high[1] - low[1], 0) + 1
        if not isinstance(self.placement, EntirePatch) or not bool(canvas.filled.any()):
            return _Spots(number, *low, piece.image.new_zeros(rows, cols))
        index, inside = canvas.part(*low, low[0] + rows + hz - 1, low[1] + cols + wz - 1)
        costs, areas = ssd_canvas(
            canvas.views[0][:, index[0], index[1]], canvas.filled[index] & inside, piece.image,
            usable=piece.usable,
        )  # fmt: skip
        whole = (slice(hz - 1, hz - 1 + rows), slice(wz - 1, wz - 1 + cols))
        areas = areas[whole]
        costs = costs[whole] / areas.clamp(min=1)
        return _Spots(number, *low, torch.where(areas * 20 >= areas.max(), costs, torch.inf))

    def _tell(self, done: float, note: str) -> None:
        if self.on_step is not None:
            self.on_step(Stage(min(done, 1.0), note, self.canvas.views[0].clone()))


def _reach(at: int, extent: int, side: int) -> tuple[int, int]:
    """First and last translation, along an axis, of a piece over a square around a place."""
    if side > 1:
        return at - extent + 1 + side // 2, at - side // 2
    # a pixel: overlap by a margin what is before it, and leave half of the piece for what is after
    last = at - min(at, extent // MARGIN)
    return max(at - extent + 1, last - extent // 2), last


def _total(views: Float[Tensor, "5 c h w"], gradient: bool) -> float:
    return float(sum(costs.double().sum() for costs in present_seams(views, gradient=gradient)))


def _canvas(pieces: list[_Piece], size: tuple[int, int], periodic: bool) -> _Canvas:
    like, source = pieces[0].image, pieces[0].positions
    return _Canvas(
        like.new_zeros(5, len(like), *size),
        torch.zeros(size, dtype=torch.bool, device=like.device),
        source.new_zeros(*size, 3),
        torch.zeros(size, dtype=torch.long, device=like.device),
        torch.zeros(size, dtype=torch.long, device=like.device),
        like.new_zeros(size),
        periodic,
    )


def _pieces(
    zs: list[Tensor], keep: list[Tensor | None], turns: bool, mirrors: bool, scales: Sequence[float]
) -> list[_Piece]:
    shapes = [(z.shape[1], z.shape[2]) for z in zs]
    marks = [torch.ones_like(z[:1]) if m is None else m[None].to(z)
             for z, m in zip(zs, keep, strict=True)]  # fmt: skip
    pieces = []
    for number, (height, width) in enumerate(shapes):
        for scale in dict.fromkeys(scales):
            base = _positions(number, height, width, scale, all(s == 1 for s in scales))
            base = base.to(zs[0].device)
            for turn in range(4 if turns else 1):
                for mirrored in (False, True) if mirrors else (False,):
                    positions = base.rot90(turn, (0, 1))
                    positions = positions.flip(1) if mirrored else positions
                    source = copied(positions, shapes)
                    usable = source.apply(marks)[0] >= 1
                    if bool(usable.any()):
                        places = _places(positions, shapes)
                        pieces.append(_piece(source.apply(zs), positions, places, usable))
    if not pieces:
        raise ValueError("masks leave no pixel of a scaled exemplar; widen them")
    return pieces


def _positions(number: int, height: int, width: int, scale: float, whole: bool) -> Tensor:
    """(h, w, 3): where every pixel of an exemplar enlarged by `scale` comes from."""
    lines = []
    for extent in (height, width):
        count = max(1, round(extent * scale))
        line = (torch.arange(count, dtype=torch.float64) + 0.5) * (extent / count) - 0.5
        lines.append(line.clamp(0, extent - 1))
    rows, cols = torch.meshgrid(*lines, indexing="ij")
    found = torch.stack([torch.full_like(rows, number), rows, cols], -1)
    return found.round().long() if whole else found.float()  # as they are kept in files


def _places(positions: Tensor, shapes: list[tuple[int, int]]) -> Tensor:
    number = int(positions[0, 0, 0])
    before = sum(h * w for h, w in shapes[:number])
    nearest = positions[..., 1:].round().long()
    return before + nearest[..., 0] * shapes[number][1] + nearest[..., 1]


def _piece(image: Tensor, positions: Tensor, places: Tensor, usable: Tensor) -> _Piece:
    views = patch_views(image)
    # a neighbor that may not be used is taken to look like the pixel itself
    known = patch_views(usable[None].to(image)) > 0
    views = torch.where(known, views, image)
    part = image[:, usable].double()
    variance = float((part - part.mean(1, keepdim=True)).square().mean(1).sum())
    search = ssd_search(image, None if bool(usable.all()) else usable)
    return _Piece(image, views, positions, places, usable, search, variance)


def _solved(canvas: _Canvas, texture: Tensor) -> Tensor:
    """The image whose differences are those of the patches, on seams the mean of both sides'."""
    here, below, right, above, left = canvas.views
    across = (right - here + (here - left).roll(-1, 2)) / 2
    down = (below - here + (here - above).roll(-1, 1)) / 2
    if not canvas.periodic:
        across, down = across[:, :, :-1], down[:, :-1]
    guidance = Guidance(across, down, canvas.periodic)
    return solve(guidance, texture, boundary="free").clamp(0, 1)


def _fitted(placement: SubPatch, pieces: list[_Piece], size: tuple[int, int]) -> SubPatch:
    least, canvas = min(min(p.shape) for p in pieces), min(size)
    if placement.patch is None:
        return replace(placement, patch=max(1, min(least // 3, canvas)))
    if placement.patch > least:
        raise ValueError(
            f"patch={placement.patch} is larger than an exemplar, scaled, of {least} pixels; "
            f"choose at most {least}"
        )
    if placement.patch > canvas:
        raise ValueError(
            f"patch={placement.patch} is larger than size={size[0]}x{size[1]}; "
            f"choose at most {canvas}"
        )
    return placement


def _check_draw(k: float, spread: float) -> None:
    if not 0 < k < float("inf"):
        raise ValueError(f"k={k} must be above 0, and finite")
    check_not_negative("spread", spread)


def _check_options(refine: int | None, scales: Sequence[float], boundary: str) -> None:
    if refine is not None and refine < 0:
        raise ValueError(f"refine={refine} must be at least 0")
    if not scales:
        raise ValueError("scales is empty; give at least one, such as 1")
    for scale in scales:
        if not 0.1 <= scale <= 10:
            raise ValueError(f"scales={scale} must lie in 0.1..10; 1 is the exemplar as it is")
    if boundary not in ("free", "periodic"):
        raise ValueError(f'boundary="{boundary}" must be "free" or "periodic"')
