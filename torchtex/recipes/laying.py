"""Patches laid into holes one by one: where the next one goes, which it is, how much stays."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut
from torchtex.cuts.seams import cut_patch, patch_views
from torchtex.patches import box_sums, summed_area
from torchtex.picks import pick
from torchtex.recipes.patch_finders import Finder
from torchtex.sources import pixel_places

_CONTEXT = 3  # in scan order, the part of a patch's side that lies before the empty pixel
_SEEN = 1 / 255  # mean steps from pixel to pixel that are less are alike


@dataclass
class Canvas:
    """What is there: views, sources and patches of pixels, and which must stay.

    Args:
        views: of `patch_views`, of what is known so far.
        empty: pixels of holes that are left.
        held: pixels that must stay.
        positions: source, row and column of every pixel.
        patches: number of the patch that a pixel belongs to.
    """

    views: Float[Tensor, "5 c h w"]
    empty: Bool[Tensor, "h w"]
    held: Bool[Tensor, "h w"]
    positions: Float[Tensor, "h w 3"]
    patches: Int[Tensor, "h w"]


@dataclass
class Laying:
    """Fills a canvas.

    Args:
        finder: costs of patches.
        views: of the sources.
        side: of a patch.
        tolerance, apart, fresh, detail: see `complete`.
        generator: of what is drawn.
        first: number of the first source.
        count: patches laid; `energy` is what they cost, for `compared` known pixels.

    Example:
        >>> from torchtex.cuts.mincut import default_solver
        >>> from torchtex.recipes.patch_finders import finder_of
        >>> z, known = torch.rand(1, 20, 20), torch.ones(20, 20, dtype=torch.bool)
        >>> known[8:12, 8:12] = False
        >>> canvas = canvas_of(z, known, None, 2)
        >>> run = Laying(canvas, finder_of("fft", [z], [known], 6), [known_views(z, known)], 6,
        ...              0.0, 0, 0.0, 0.0, default_solver(), torch.Generator(), 0)
        >>> run.paste(*run.scanned())
        >>> canvas.empty[8, 8].item(), run.count
        (False, 1)
    """

    canvas: Canvas
    finder: Finder
    views: Sequence[Float[Tensor, "5 c _ _"]]
    side: int
    tolerance: float
    apart: int
    fresh: float
    detail: float
    solver: MinCut
    generator: torch.Generator
    first: int  # number of the first source
    count: int = 0
    energy: float = 0.0
    compared: int = 0

    def __post_init__(self) -> None:
        self.confidence = (~self.canvas.empty).double()
        sizes = [view.shape[2:] for view in self.views]
        self.used = [self.confidence.new_zeros(size) for size in sizes]  # times, of pixels
        self.steps = [summed_area(_steps(view)) for view in self.views]
        known = patch_views((~self.canvas.empty)[None].double())[:, 0]
        around = _steps(self.canvas.views) * known[0], known[0] * known[1:3].sum(0)
        self.around = [summed_area(x) for x in around]

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
        self.used[number][row : row + side, col : col + side] += empty
        canvas.empty[window] = False

    def _found(self, old: Tensor, zone: Tensor, top: int, left: int) -> tuple[int, int, int]:
        """Source, row and column of a patch that fits."""
        device = self.generator.device
        if not bool(zone.any()):
            places = self.finder.places()
            drawn = torch.randint(len(places), (1,), generator=self.generator, device=device)
            number, row, col = places[int(drawn)].tolist()
            return number, row, col
        places = self.finder.places()
        dearer = (self._staleness(places) * self._strangeness(places, ~zone, top, left)).to(old)
        costs, found = self.finder(old, zone, dearer)
        places, dearer = places[found], dearer[found]
        if self.apart:
            near = (places[:, 1:] - places.new_tensor([top, left])).abs().amax(1) < self.apart
            same = [v.shape[2:] == self.canvas.empty.shape for v in self.views]
            near &= torch.tensor(same, device=places.device)[places[:, 0]]
            if not bool(near.all()):
                costs = torch.where(near, torch.inf, costs)
        best = pick((costs * dearer)[None], self.tolerance, self.generator)[1]
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

    def _staleness(self, places: Int[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """1 for a patch of which nothing was used before, and more for others.

        What is flat fits in wherever something is not clear, and would fill all holes.
        """
        found = self.confidence.new_ones(len(places))
        for number, used in enumerate(self.used):
            if self.fresh > 0 and bool(used.any()):
                own = places[:, 0] == number
                times = box_sums(summed_area(used), self.side, self.side) / self.side**2
                found[own] += self.fresh * times[places[own, 1], places[own, 2]]
        return found

    def _strangeness(
        self, places: Int[Tensor, "n 3"], empty: Bool[Tensor, "h w"], top: int, left: int
    ) -> Float[Tensor, "n"]:
        """1 for a patch that fills a window with as much detail as around it, and more for others.

        Where not all can fit, what is flat differs least, so holes would be filled with it.
        """
        found = self.confidence.new_ones(len(places))
        usual = None if self.detail == 0 else self._usual(top, left)
        if usual is None:
            return found
        rows, cols = (empty.any(axis).nonzero().flatten() for axis in (1, 0))
        row, col = rows[0], cols[0]
        height, width = int(rows[-1] - row) + 1, int(cols[-1] - col) + 1
        for number, table in enumerate(self.steps):
            own = places[:, 0] == number
            sums = box_sums(table, height, width)[places[own, 1] + row, places[own, 2] + col]
            ratio = (sums / (2 * height * width)).clamp(min=_SEEN) / max(usual, _SEEN)
            found[own] += self.detail * ratio.log().abs()
        return found

    def _usual(self, top: int, left: int) -> float | None:
        """Mean step from pixel to pixel that was known around a window, or else anywhere."""
        sums, counts = self.around
        (h, w), reach = self.canvas.empty.shape, self.side // 2
        near = [max(top - reach, 0), min(top + self.side + reach, h),
                max(left - reach, 0), min(left + self.side + reach, w)]  # fmt: skip
        for above, below, before, behind in (near, (0, h, 0, w)):
            step, count = (
                float(t[below, behind] - t[above, behind] - t[below, before] + t[above, before])
                for t in (sums, counts)
            )
            if count > 0:
                return step / count
        return None


def _steps(views: Float[Tensor, "5 c h w"]) -> Float[Tensor, "h w"]:
    """Steps to the right and down of every pixel, in the mean of channels."""
    return (views[1:3] - views[0]).abs().mean(1).sum(0)


def known_views(z: Tensor, usable: Tensor | None) -> Float[Tensor, "5 c h w"]:
    """Views in which a neighbour that may not be used looks like the pixel itself.

    Example:
        >>> views = known_views(torch.tensor([[[1.0, 2.0]]]), torch.tensor([[True, False]]))
        >>> views[2, 0].tolist()  # to the right
        [[1.0, 2.0]]
    """
    views = patch_views(z)
    return views if usable is None else torch.where(patch_views(usable[None].to(z)) > 0, views, z)


def canvas_of(image: Tensor, known: Tensor, positions: Tensor | None, rim: int) -> Canvas:
    """An image with holes, of which pixels farther than `rim` from them must stay.

    Args:
        positions: where pixels come from; None for their own places in source 0.

    Example:
        >>> canvas = canvas_of(torch.ones(1, 1, 3), torch.tensor([[True, True, False]]), None, 1)
        >>> canvas.held.tolist(), canvas.empty.tolist()
        ([[True, False, False]], [[False, False, True]])
    """
    near = F.max_pool2d((~known)[None].double(), 2 * rim + 1, 1, rim)[0] > 0
    if positions is None:
        positions = F.pad(pixel_places(known.shape, image.device), (1, 0)).float()
    patches = torch.zeros(known.shape, dtype=torch.long, device=image.device)
    return Canvas(known_views(image, known), ~known, ~near, positions.clone(), patches)
