"""Completion: holes filled patch by patch from a source, each patch cut in by min-cut.

The first empty pixel in scan order, or the one that knows most around it, gets a patch: what is
known there is looked for in the source, all of the best match is laid over it, and a min-cut
decides how much of the known part it replaces. Greedy and quick, for texture and for many holes
at once; `fill` solves for all of a hole together, which is slower and better for one large hole in
a photo.

Source: Shen et al. 2006, Completion-based texture design, sections 3.4 and 3.6; the order by
confidence, Criminisi et al. 2004; the search by quadtree pyramids, Shen et al. 2010, section 3.4.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.cuts.poisson import Guidance, solve
from torchtex.cuts.seams import cut_patch, patch_views
from torchtex.inputs import Exemplars, Masks, check_not_negative, check_seed, usable_exemplars
from torchtex.patches import box_sums, pick, summed_area
from torchtex.quadratic import threads
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.patch_finders import Finder, Search, finder_of
from torchtex.sources import copied, pixel_places

Order = Literal["scan", "confidence"]
_CONTEXT = 3  # in scan order, the part of a patch's side that lies before the empty pixel


def complete(
    image: Float[Tensor, "c h w"],
    mask: Bool[Tensor, "_ _"],
    *,
    source: Exemplars | None = None,
    source_masks: Masks = None,
    patch: int = 32,
    order: Order = "scan",
    search: Search = "fft",
    tolerance: float = 0.0,
    rim: int = 8,
    apart: int = 0,
    poisson: bool = True,
    positions: Float[Tensor, "_ _ 3"] | None = None,
    solver: MinCut | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """Holes completed with patches of a source, joined by min-cuts.

    Exemplar 0 of the result's field is the image and those after it the sources, if there are
    any; `patches` is 0 for what was there. Pixels farther than `rim` from a hole keep their bits.

    Args:
        image: (c, h, w) in [0, 1]; what the holes hold changes nothing, it may be NaN.
        mask: True in the holes.
        source: where patches come from, one image or several; None for the image's own known
            pixels.
        source_masks: True where a source may be used; one per source.
        patch: side of a patch in pixels.
        order: "scan", row by row, or "confidence", where most is known first.
        search: "fft" and "exhaustive" cost all places, by Fourier transforms and by definition;
            "qtp" goes from coarse to fine and looks at a few of them.
        tolerance: how much dearer than the best match a drawn one may be; 0.1: 10 %.
        rim: pixels around a hole that patches may replace, so that seams are better.
        apart: a source of the size of the image gives no patch from nearer than this to its own
            place: a hole would be filled with what was there before.
        poisson: even out levels along the seams, in the holes and their rim.
        positions: places in the sources that the image is made of, if it is; the field then has
            the sources alone.
        solver: of the min-cuts; None for the first one that is installed.
        seed: of what `tolerance` leaves open.
        on_step: called after each patch; raise from it to cancel.

    Returns:
        A montage; its settings hold the number of patches and their mean matching cost per
        known pixel, `energy`.

    Raises:
        ValueError: a mask that is empty, full without a source, or of another size, a patch that
            fits nowhere in the source, or an option out of range.

    Example:
        >>> z = torch.rand(3, 40, 40)
        >>> hole = torch.zeros(40, 40, dtype=torch.bool)
        >>> hole[20:30, 15:28] = True
        >>> done = complete(z, hole, patch=12)
        >>> done.texture.shape, done.patches[0, 0].item()
        (torch.Size([3, 40, 40]), 0)
    """
    began = time.perf_counter()
    _check(image, mask, source, patch, order, tolerance, rim, apart, seed)
    solver = default_solver() if solver is None else solver
    known = ~mask
    image = torch.where(known, image.detach(), 0)
    own = source is None
    zs, keep = usable_exemplars(*((image, known) if source is None else (source, source_masks)))
    if zs[0].shape[0] != image.shape[0] or zs[0].dtype != image.dtype:
        raise ValueError(
            f"source has {zs[0].shape[0]} channels of {zs[0].dtype} and image {image.shape[0]} of "
            f"{image.dtype}; give both the same"
        )
    shapes = [(z.shape[1], z.shape[2]) for z in zs]
    side = min(patch, *image.shape[1:])
    if side > min(min(shape) for shape in shapes):
        raise ValueError(
            f"patch={patch} is larger than a source of {min(min(s) for s in shapes)} pixels; "
            "choose a smaller one"
        )
    with threads(1):  # the pieces are small
        finder = finder_of(search, zs, keep, side)
        views = [_known_views(z, k) for z, k in zip(zs, keep, strict=True)]
        canvas = _canvas(image, known, positions, rim)
        run = _Run(
            canvas, finder, views, side, tolerance, 0 if own else apart, solver,
            torch.Generator().manual_seed(seed), 0 if own or positions is not None else 1,
        )  # fmt: skip
        place = run.scanned if order == "scan" else run.surest
        total = int(mask.sum())
        while bool(canvas.empty.any()):
            run.paste(*place())
            if on_step is not None:
                done = 1 - int(canvas.empty.sum()) / total
                on_step(Stage(done, "completion", canvas.views[0].clone()))
        texture = canvas.views[0]
        if poisson:
            texture = _evened(canvas, texture)
    if positions is None and not own:
        shapes = [(image.shape[1], image.shape[2]), *shapes]
    field = copied(_whole(canvas.positions), shapes)
    settings = {
        "recipe": "complete", "pixels": total, "patch": side, "order": order,
        "search": search if isinstance(search, str) else repr(search), "tolerance": tolerance,
        "rim": rim, "apart": apart, "poisson": poisson, "solver": type(solver).__name__,
        "pasted": run.count, "energy": run.energy / max(run.compared, 1),
    }  # fmt: skip
    return Montage(texture, field, canvas.patches, time.perf_counter() - began, seed, settings)


@dataclass
class _Canvas:
    """What is there: views, sources and patches of pixels, and which must stay."""

    views: Float[Tensor, "5 c h w"]
    empty: Bool[Tensor, "h w"]
    held: Bool[Tensor, "h w"]
    positions: Float[Tensor, "h w 3"]
    patches: Int[Tensor, "h w"]


@dataclass
class _Run:
    canvas: _Canvas
    finder: Finder
    views: Sequence[Float[Tensor, "5 c _ _"]]
    side: int
    tolerance: float
    apart: int
    solver: MinCut
    generator: torch.Generator
    first: int  # number of the first source
    count: int = 0
    energy: float = 0.0
    compared: int = 0

    def __post_init__(self) -> None:
        self.confidence = (~self.canvas.empty).double()

    def scanned(self) -> tuple[int, int]:
        """A window with the first empty pixel in it, a third of it before that pixel."""
        h, w = self.canvas.empty.shape
        row, col = divmod(int(self.canvas.empty.flatten().byte().argmax()), w)
        reach = self.side // _CONTEXT
        top = min(max(row - reach, 0), h - self.side)
        # of the windows that hold the pixel and what lies before it, the emptiest
        low = max(col - self.side + reach, 0)
        low, high = min(low, w - self.side), min(max(col - reach, 0), w - self.side)
        strip = self.canvas.empty[top : top + self.side, low : high + self.side].double().sum(0)
        sums = F.pad(strip.cumsum(0), (1, 0))
        gain = sums[self.side :] - sums[: -self.side]
        return top, low + len(gain) - 1 - int(gain.flip(0).argmax())

    def surest(self) -> tuple[int, int]:
        """The window around the empty pixel beside known ones whose window is known best."""
        side, empty = self.side, self.canvas.empty
        h, w = empty.shape
        half = side // 2
        around = F.pad(self.confidence[None], (half, side - 1 - half) * 2)
        sums = box_sums(summed_area(around[0]), side, side) / side**2
        beside = F.max_pool2d((~empty)[None].double(), 3, 1, 1)[0] > 0
        front = empty & beside if bool((empty & beside).any()) else empty
        best = int(torch.where(front, sums, -1).argmax())
        row, col = divmod(best, w)
        top, left = min(max(row - half, 0), h - side), min(max(col - half, 0), w - side)
        window = (slice(top, top + side), slice(left, left + side))
        self.confidence[window] = torch.where(
            empty[window], sums[row, col], self.confidence[window]
        )
        return top, left

    def paste(self, top: int, left: int) -> None:
        """Finds a patch for a window, and cuts it in."""
        canvas, side = self.canvas, self.side
        window = (slice(top, top + side), slice(left, left + side))
        old, empty = canvas.views[:, :, window[0], window[1]], canvas.empty[window]
        number, row, col = self._found(old[0], ~empty, top, left)
        new = self.views[number][..., row : row + side, col : col + side]
        labels = empty
        if not bool(empty.all()):
            # neighbours that are not here must find what they have beside them
            first = (canvas.held[window] | self._beside(window)) & ~empty
            blank = torch.where(empty, new, old)
            labels = cut_patch(blank, new, first, empty, gradient=True, solver=self.solver)
        self.count += 1
        canvas.views[:, :, window[0], window[1]] = torch.where(labels, new, old)
        place = pixel_places((side, side), new.device) + torch.tensor([row, col], device=new.device)
        source = F.pad(place.to(canvas.positions), (1, 0), value=self.first + number)
        canvas.positions[window] = torch.where(labels[..., None], source, canvas.positions[window])
        canvas.patches[window] = torch.where(labels, self.count, canvas.patches[window])
        canvas.empty[window] = False

    def _found(self, old: Tensor, zone: Tensor, top: int, left: int) -> tuple[int, int, int]:
        """Source, row and column of a patch that fits."""
        device = self.generator.device
        if not bool(zone.any()):
            places = self.finder.places()
            drawn = torch.randint(len(places), (1,), generator=self.generator, device=device)
            number, row, col = places[int(drawn)].tolist()
            return number, row, col
        costs, places = self.finder(old, zone)
        if self.apart:
            near = (places[:, 1:] - places.new_tensor([top, left])).abs().amax(1) < self.apart
            same = [v.shape[2:] == self.canvas.empty.shape for v in self.views]
            near &= torch.tensor(same, device=places.device)[places[:, 0]]
            if not bool(near.all()):
                costs = torch.where(near, torch.inf, costs)
        best = pick(costs[None], self.tolerance, self.generator)[1]
        self.energy += float(costs[best])
        self.compared += int(zone.sum())
        number, row, col = places[best].tolist()
        return number, row, col

    def _beside(self, window: tuple[slice, slice]) -> Bool[Tensor, "h w"]:
        """Pixels at the border of a window that known ones lie next to, outside of it."""
        known, (rows, cols) = F.pad(~self.canvas.empty, (1, 1, 1, 1)), window
        edge = torch.zeros_like(self.canvas.empty[window])
        edge[0] |= known[rows.start, cols.start + 1 : cols.stop + 1]
        edge[-1] |= known[rows.stop + 1, cols.start + 1 : cols.stop + 1]
        edge[:, 0] |= known[rows.start + 1 : rows.stop + 1, cols.start]
        edge[:, -1] |= known[rows.start + 1 : rows.stop + 1, cols.stop + 1]
        return edge


def _known_views(z: Tensor, usable: Tensor | None) -> Float[Tensor, "5 c h w"]:
    """Views in which a neighbour that may not be used looks like the pixel itself."""
    views = patch_views(z)
    return views if usable is None else torch.where(patch_views(usable[None].to(z)) > 0, views, z)


def _canvas(image: Tensor, known: Tensor, positions: Tensor | None, rim: int) -> _Canvas:
    near = F.max_pool2d((~known)[None].double(), 2 * rim + 1, 1, rim)[0] > 0
    if positions is None:
        positions = F.pad(pixel_places(known.shape, image.device), (1, 0)).float()
    patches = torch.zeros(known.shape, dtype=torch.long, device=image.device)
    return _Canvas(_known_views(image, known), ~known, ~near, positions.clone(), patches)


def _evened(canvas: _Canvas, texture: Tensor) -> Tensor:
    """Pixels found anew from their differences where patches are, on seams the mean of both."""
    here, below, right, above, left = canvas.views
    across = (right - here)[:, :, :-1] + (here - left)[:, :, 1:]
    down = (below - here)[:, :-1] + (here - above)[:, 1:]
    changed = ~canvas.held
    guidance = Guidance(across / 2, down / 2)
    return solve(guidance, texture, changed, boundary="free").clamp(0, 1)


def _whole(positions: Tensor) -> Tensor:
    """Positions as whole numbers if all of them are."""
    nearest = positions.round()
    return nearest.long() if bool((nearest == positions).all()) else positions


def _check(
    image: Tensor, mask: Tensor, source: Exemplars | None, patch: int, order: str,
    tolerance: float, rim: int, apart: int, seed: int,
) -> None:  # fmt: skip
    if image.ndim != 3 or mask.shape != image.shape[1:]:
        raise ValueError(
            f"mask is {tuple(mask.shape)} and image {tuple(image.shape)}; give a mask of the size "
            "of the image"
        )
    if not bool(mask.any()):
        raise ValueError("mask is True nowhere; mark the holes")
    if source is None and bool(mask.all()):
        raise ValueError(
            "mask is True everywhere and there is no source; give one, or leave pixels"
        )
    if order not in ("scan", "confidence"):
        raise ValueError(f"order={order!r} is unknown; choose scan or confidence")
    if patch < 3:
        raise ValueError(f"patch={patch} must be at least 3 pixels")
    for name, value in (("rim", rim), ("apart", apart)):
        if value < 0:
            raise ValueError(f"{name}={value} must be at least 0 pixels")
    check_not_negative("tolerance", tolerance)
    check_seed(seed)
