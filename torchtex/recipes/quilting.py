"""Image quilting: square blocks side by side, with the best seam in their overlaps.

`quilt` makes a texture, `transfer` a texture that shows a target picture.
Source: Efros and Freeman 2001, Image quilting for texture synthesis and transfer.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.cuts.mincut import MinCut
from torchtex.cuts.paths import quilt_cut, quilt_mask
from torchtex.cuts.seams import patch_views
from torchtex.image import check_image
from torchtex.inputs import (
    Exemplars,
    Masks,
    check_not_negative,
    check_seed,
    check_size,
    memory_of,
    usable_exemplars,
)
from torchtex.label_spaces import LabelSpace
from torchtex.layouts import Layout, costs_of_places, layout_of, places_of
from torchtex.patches import SsdSearch, ssd_search
from torchtex.picks import pick
from torchtex.quadratic import threads
from torchtex.recipes.correspondence import Correspondence, blurred_luminance
from torchtex.recipes.montage import Montage, Stage
from torchtex.sources import copied, pixel_places

Window = tuple[slice, slice]
_SHARE = 0.28  # of the exemplar's side is a block's, unless given
_NEAR = 2  # pixels around a continuation that count as one


def quilt(
    exemplars: Exemplars,
    size: tuple[int, int],
    *,
    block: int | None = None,
    overlap: int | None = None,
    tolerance: float = 0.1,
    cut: Literal["dp", "mincut"] = "dp",
    solver: MinCut | None = None,
    continuing: bool = False,
    masks: Masks = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """A texture of blocks that agree with those before them where they overlap.

    Blocks are laid row by row. Each is drawn from those whose squared error in the overlaps is
    at most (1 + tolerance) times the least, and joins the texture along a seam of least error.

    Args:
        exemplars: one image, or several with equal channels.
        size: (height, width) of the texture.
        block: side of a block; None for 0.28 of the shortest side of the exemplars.
        overlap: of neighbors; None for a sixth of the block.
        cut: "dp" for two paths, as in the paper, or "mincut" for one cut of any shape.
        solver: of "mincut"; None for the first one that is installed.
        continuing: also allow the block that goes on in the exemplar where a neighbor ends. It
            fits without error, so it nearly always wins: large pieces are then copied whole.
        masks: True where an exemplar may be used; one per exemplar.
        on_step: called after every row of blocks; may raise to cancel.

    Raises:
        ValueError: an option out of range, or a block that fits nowhere.

    Source: Efros and Freeman 2001, section 2; leaving continuations out is ours.

    Example:
        >>> result = quilt(torch.rand(3, 32, 32), (40, 50), block=12, overlap=3)
        >>> result.texture.shape
        torch.Size([3, 40, 50])
    """
    started = time.perf_counter()
    zs, keep = usable_exemplars(exemplars, masks)
    check_size(size, memory_of(zs[0], size, images=8, numbers=12))
    layout = layout_of(zs, size, block, overlap, share=_SHARE, name="block")
    maker = _maker(zs, keep, tolerance, cut, solver, seed, continuing)
    with threads(1):  # the pieces are small
        sheet = maker.lay(layout, _Errors(), _reporter(on_step, "blocks", 0, 1))
    settings = {"recipe": "quilt", "continuing": continuing}
    return _montage(sheet, maker, layout, started, seed, settings)


def transfer(
    exemplars: Exemplars,
    target: Float[Tensor, "_ h w"],
    *,
    correspondence: Correspondence | None = None,
    block: int | None = None,
    overlap: int | None = None,
    iterations: int = 3,
    tolerance: float = 0.1,
    cut: Literal["dp", "mincut"] = "dp",
    solver: MinCut | None = None,
    masks: Masks = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """The target, rendered in the texture of the exemplars.

    As `quilt`, but the error of a block is alpha times the squared error in the overlaps plus
    1 - alpha times that of the correspondence, both per channel. Iteration i of N has
    alpha = 0.8 (i - 1) / (N - 1) + 0.1 (0.1 when N = 1) and blocks a third smaller than the one
    before; it also compares the rest of a block with what the one before made there.

    Args:
        exemplars: one image, or several with equal channels.
        target: any number of channels; the texture gets its size.
        correspondence: None for `blurred_luminance`.
        block: side of a block in the first iteration; None for 0.14 of the shortest side.
        overlap: of neighbors in the first iteration; None for a sixth of the block.
        iterations: how many passes.
        tolerance, cut, solver, masks, on_step: as in `quilt`.

    Raises:
        ValueError: an option out of range, a block that fits nowhere, or maps of other sizes.

    Source: Efros and Freeman 2001, section 3.

    Example:
        >>> result = transfer(torch.rand(3, 24, 24), torch.rand(1, 20, 30), iterations=2)
        >>> result.texture.shape
        torch.Size([3, 20, 30])
    """
    started = time.perf_counter()
    zs, keep = usable_exemplars(exemplars, masks)
    check_image(target, "target")
    size = (target.shape[1], target.shape[2])
    first = layout_of(zs, size, block, overlap, share=_SHARE / 2, name="block")
    if iterations < 1:
        raise ValueError(f"iterations={iterations} must be at least 1")
    maker = _maker(zs, keep, tolerance, cut, solver, seed, True)
    maps = blurred_luminance(zs, target, masks=keep) if correspondence is None else correspondence
    maps.check(zs, size)
    wanted = tuple(ssd_search(z.to(zs[0])) for z in maps.exemplars)
    errors, sheet = _Errors(), None
    with threads(1):
        for i in range(iterations):
            layout = first.shrunk((2 / 3) ** i)
            errors = _Errors(
                0.1 + 0.8 * i / max(iterations - 1, 1),
                wanted,
                layout.padded(maps.target.to(zs[0])),
                None if sheet is None else layout.padded(sheet.pixels[:, : size[0], : size[1]]),
            )
            report = _reporter(on_step, f"iteration {i + 1} of {iterations}", i, iterations)
            sheet = maker.lay(layout, errors, report)
    assert sheet is not None
    settings = {"recipe": "transfer", "iterations": iterations}
    return _montage(sheet, maker, first, started, seed, settings)


@dataclass(frozen=True)
class _Sheet:
    """A canvas: its pixels, the number of every pixel's block, and where each block is from."""

    pixels: Tensor
    patches: Tensor
    origins: Tensor


@dataclass(frozen=True)
class _Errors:
    """How the places for a block are judged; all but the overlaps is of a transfer."""

    alpha: float = 1.0
    wanted: tuple[SsdSearch, ...] = ()
    target: Tensor | None = None
    before: Tensor | None = None

    def __call__(
        self, maker: "_Maker", space: LabelSpace, canvas: Tensor, window: Window, known: Tensor
    ) -> Float[Tensor, "n"]:
        template = canvas[:, window[0], window[1]]
        if self.before is not None:
            template = torch.where(known, template, self.before[:, window[0], window[1]])
            known = torch.ones_like(known)
        costs = canvas.new_zeros(len(space.positions))
        if bool(known.any()):
            found = [search(template[None], known)[0] for search in maker.searches]
            costs = costs_of_places(space, found) * (self.alpha / len(template))
        if self.target is None:
            return costs
        template = self.target[:, window[0], window[1]]
        share = (1 - self.alpha) / len(template)
        found = [search(template[None])[0] for search in self.wanted]
        return costs + share * costs_of_places(space, found)


@dataclass(frozen=True)
class _Dp:
    """Two paths through the overlaps."""

    def views(self, image: Tensor) -> Tensor:
        """What the canvas keeps of an image: its pixels."""
        return image[None]

    def mask(self, old: Tensor, new: Tensor, left: int, top: int) -> Tensor:
        """True where the new block goes."""
        return quilt_mask(old[0], new[0], left, top)


@dataclass(frozen=True)
class _Cut:
    """One min-cut, which knows older seams in the overlaps."""

    solver: MinCut | None

    def views(self, image: Tensor) -> Tensor:
        """What the canvas keeps of an image: its pixels and what lies around them."""
        return patch_views(image)

    def mask(self, old: Tensor, new: Tensor, left: int, top: int) -> Tensor:
        """True where the new block goes."""
        return quilt_cut(old, new, left, top, solver=self.solver)


@dataclass(frozen=True)
class _Maker:
    """What stays the same from block to block."""

    images: list[Tensor]
    masks: list[Tensor | None]
    searches: tuple[SsdSearch, ...]
    tolerance: float
    seam: "_Dp | _Cut"
    continuing: bool
    generator: torch.Generator

    def lay(
        self, layout: Layout, errors: _Errors, report: Callable[[float, Tensor], None]
    ) -> _Sheet:
        """All blocks, row by row."""
        first, side = self.images[0], layout.side
        space = places_of(self.images, self.masks, side, "block")
        places = space.positions.to(first.device)
        (rows, cols), step = layout.count, layout.step
        origins = places.new_zeros(rows * cols, 3)
        sheets = [self.seam.views(z) for z in self.images]
        canvas = first.new_zeros(*sheets[0].shape[:2], *layout.extent)
        patches = places.new_zeros(layout.extent)
        for n in range(rows * cols):
            i, j = divmod(n, cols)
            top, left = layout.overlap * (i > 0), layout.overlap * (j > 0)
            window, known = layout.window(i, j), layout.known(i, j, first.device)
            costs = errors(self, space, canvas[0], window, known)
            if not self.continuing:
                after = [origins[n - 1] + origins.new_tensor([0, 0, step])] if j else []
                after += [origins[n - cols] + origins.new_tensor([0, step, 0])] if i else []
                costs = _without(costs, places, after)
            place = places[pick(costs[None], self.tolerance, self.generator)[1]]
            number, row, col = place.tolist()
            new = sheets[number][..., row : row + side, col : col + side]
            old = canvas[..., window[0], window[1]]
            mask = self.seam.mask(old, new, left, top)
            old.copy_(torch.where(mask, new, old))
            patches[window].masked_fill_(mask, n)
            origins[n] = place
            if j == cols - 1:
                report((i + 1) / rows, canvas[0, :, : layout.size[0], : layout.size[1]])
        corners = origins.new_tensor([[0, n // cols, n % cols] for n in range(len(origins))]) * step
        return _Sheet(canvas[0], patches, origins - corners)


def _without(costs: Tensor, places: Tensor, after: list[Tensor]) -> Tensor:
    """Costs that rule out where neighbors go on, unless nothing else is left."""
    barred = torch.zeros_like(costs, dtype=torch.bool)
    for place in after:
        apart = (places - place).abs()
        barred |= (apart[:, 0] == 0) & (apart[:, 1:] <= _NEAR).all(1)
    return costs if bool(barred.all()) else costs.masked_fill(barred, torch.inf)


def _montage(
    sheet: _Sheet, maker: _Maker, layout: Layout, started: float, seed: int, about: dict[str, Any]
) -> Montage:
    height, width = layout.size
    patches = sheet.patches[:height, :width].contiguous()
    sources = sheet.origins[patches]
    sources[..., 1:] += pixel_places(layout.size, patches.device)
    settings = about | {
        "size": list(layout.size),
        "block": layout.side,
        "overlap": layout.overlap,
        "tolerance": maker.tolerance,
        "cut": "dp" if isinstance(maker.seam, _Dp) else "mincut",
    }
    return Montage(
        sheet.pixels[:, :height, :width].contiguous(),
        copied(sources, [(z.shape[1], z.shape[2]) for z in maker.images]),
        patches,
        time.perf_counter() - started,
        seed,
        settings,
    )


def _maker(
    zs: list[Tensor],
    keep: list[Tensor | None],
    tolerance: float,
    cut: str,
    solver: MinCut | None,
    seed: int,
    continuing: bool,
) -> _Maker:
    check_not_negative("tolerance", tolerance)
    if cut not in ("dp", "mincut"):
        raise ValueError(f"cut={cut!r} is unknown; choose dp or mincut")
    check_seed(seed)
    seam = _Dp() if cut == "dp" else _Cut(solver)
    searches = tuple(ssd_search(z) for z in zs)
    generator = torch.Generator().manual_seed(seed)
    return _Maker(zs, keep, searches, tolerance, seam, continuing, generator)


def _reporter(
    on_step: Callable[[Stage], None] | None, note: str, turn: int, turns: int
) -> Callable[[float, Tensor], None]:
    def report(done: float, texture: Tensor) -> None:
        if on_step is not None:
            on_step(Stage((turn + done) / turns, note, texture.clone()))

    return report
