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
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.cuts.poisson import Guidance
from torchtex.inputs import Exemplars, Masks, check_not_negative, check_seed, usable_exemplars
from torchtex.quadratic import threads
from torchtex.recipes.laying import Canvas, Laying, canvas_of, known_views
from torchtex.recipes.levelling import levelled
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.patch_finders import Search, finder_of
from torchtex.sources import copied

Order = Literal["scan", "confidence"]


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
    fresh: float = 2.0,
    detail: float = 2.0,
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
        fresh: how much dearer a patch is whose pixels were all laid once before: 2 makes it cost
            three times as much. Otherwise what is flat would be laid again and again.
        detail: how much dearer a patch is that would fill a hole with other than the usual detail:
            2 makes it cost three times as much where its mean step from pixel to pixel is e times
            that of the known pixels around, or a part of e. Costs of matches alone prefer what is
            flat; 0 for those.
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
    _check(image, mask, source, patch, order, (tolerance, fresh, detail), (rim, apart), seed)
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
        views = [known_views(z, k) for z, k in zip(zs, keep, strict=True)]
        canvas = canvas_of(image, known, positions, rim)
        run = Laying(
            canvas, finder, views, side, tolerance, 0 if own else apart, fresh, detail,
            solver, torch.Generator().manual_seed(seed),
            0 if own or positions is not None else 1,
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
        "rim": rim, "apart": apart, "fresh": fresh, "detail": detail, "poisson": poisson,
        "solver": type(solver).__name__, "pasted": run.count,
        "energy": run.energy / max(run.compared, 1),
    }  # fmt: skip
    return Montage(texture, field, canvas.patches, time.perf_counter() - began, seed, settings)


def _evened(canvas: Canvas, texture: Tensor) -> Tensor:
    """Levels evened along seams, where differences are the mean of those of both sides."""
    here, below, right, above, left = canvas.views
    across = (right - here)[:, :, :-1] + (here - left)[:, :, 1:]
    down = (below - here)[:, :-1] + (here - above)[:, 1:]
    return levelled(texture, Guidance(across / 2, down / 2), ~canvas.held)


def _whole(positions: Tensor) -> Tensor:
    """Positions as whole numbers if all of them are."""
    nearest = positions.round()
    return nearest.long() if bool((nearest == positions).all()) else positions


def _check(
    image: Tensor, mask: Tensor, source: Exemplars | None, patch: int, order: str,
    costs: tuple[float, float, float], pixels: tuple[int, int], seed: int,
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
    for name, value in zip(("rim", "apart"), pixels, strict=True):
        if value < 0:
            raise ValueError(f"{name}={value} must be at least 0 pixels")
    for name, cost in zip(("tolerance", "fresh", "detail"), costs, strict=True):
        check_not_negative(name, cost)
    check_seed(seed)
