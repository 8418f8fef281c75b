"""Which label to offer next: the improvement of Imprv at a place, and prospects anywhere.

`Improvement` costs every label at a place, exactly, by Fourier transforms. `Prospects` does it by
windows reduced to a few axes, for some of all labels at a time, and judges a label by what the
whole output may gain by it: a sum over every few pixels of what A' falls where it falls. Seams
are not counted. What it takes for a label is a hundredth of an expansion move.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush, nsmallest

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.matching import principal_axes
from torchtex.patches import SsdSearch, ssd_search
from torchtex.recipes.labelings import Variant

AXES = 8  # that windows are reduced to
SPARSE = 8  # pixels between those that a label is judged at, in rows and in columns
PART = 80_000  # labels that one search looks at, or fewer
POOL = 2000  # labels that wait; of more, the worst are forgotten
SAMPLE = 8192  # windows that the axes are computed from
BARRED = 1e6  # in every axis, of windows whose pixel no label may show


@dataclass(frozen=True)
class Improvement:
    """Imprv of all labels at a place; made by `of`.

    Args:
        searches: for each variant, in its mapped image, its image, and both.
        usable: of each variant.
        K, N: as in `cms`.

    Source: Ramanarayanan and Bala 2007, equation 8.

    Example:
        >>> from torchtex.recipes.analogy import Analogy
        >>> from torchtex.recipes.labelings import variants
        >>> z = torch.rand(1, 9, 9)
        >>> made = variants(Analogy.of(z, z, z), turns=False)
        >>> costs = Improvement.of(made, 1.0, 1)((4, 4), z, z, torch.ones(9, 9).bool())
        >>> divmod(int(costs[0].argmin()), 9)
        (4, 4)
    """

    searches: tuple[tuple[SsdSearch, SsdSearch, SsdSearch], ...]
    usable: tuple[Tensor | None, ...]
    K: float
    N: int

    @staticmethod
    def of(made: Sequence[Variant], K: float, N: int) -> "Improvement":
        """Of windows of reach N."""
        searches = []
        for variant in made:
            image, mapped = _wider(variant.image, N), _wider(variant.mapped, N)
            both = torch.cat([image, mapped * K**0.5])
            searches.append((ssd_search(mapped), ssd_search(image), ssd_search(both)))
        return Improvement(tuple(searches), tuple(v.usable for v in made), K, N)

    def __call__(
        self,
        place: tuple[int, int],
        guide: Float[Tensor, "k h w"],
        image: Float[Tensor, "c h w"],
        known: Bool[Tensor, "h w"],
    ) -> list[Float[Tensor, "_ _"]]:
        """For each variant the cost of the label that shows one of its pixels at the place.

        Args:
            guide, image: the constraint, and the output now.
            known: pixels of the output that have a label.
        """
        N, (row, col) = self.N, place
        side = 2 * N + 1

        def window(x: Tensor) -> Tensor:
            return F.pad(x, (N, N, N, N))[..., row : row + side, col : col + side]

        inside, here = window(torch.ones_like(known)), window(known)
        theirs, shown = window(guide)[None], window(image)[None]
        whole = bool((here == inside).all())
        both = torch.cat([shown, theirs * self.K**0.5], 1)
        found = []
        for (by_mapped, by_image, by_both), usable in zip(self.searches, self.usable, strict=True):
            if whole:
                costs = by_both(both, inside)[0]
            else:
                costs = self.K * by_mapped(theirs, inside)[0]
                costs = costs + by_image(shown, here)[0] if bool(here.any()) else costs
            found.append(costs if usable is None else torch.where(usable, costs, torch.inf))
        return found


class Prospects:
    """Labels that wait to be offered, by what they promise, the best first.

    Args:
        made: variants.
        guide: the constraint.
        K, N: as in `cms`.
        generator: of the parts that are searched, and of the pixels that labels are judged at.

    Example:
        >>> from torchtex.recipes.analogy import Analogy
        >>> from torchtex.recipes.labelings import variants
        >>> z = torch.rand(3, 12, 12)
        >>> made = variants(Analogy.of(z, z, z), turns=False)
        >>> prospects = Prospects(made, z, 1.0, 1, torch.Generator().manual_seed(0))
        >>> prospects.search((4, 4), 3, torch.full((12, 12), 9.0))
        >>> prospects.best(torch.full((12, 12), 9.0))
        ((4, 4), (0, 0, 0))
    """

    def __init__(
        self,
        made: Sequence[Variant],
        guide: Float[Tensor, "k h w"],
        K: float,
        N: int,
        generator: torch.Generator,
    ):
        self.generator = generator
        axes = _axes([guide, *(v.mapped for v in made if v.upright)], N, generator) * K**0.5
        self.target = F.conv2d(_wider(guide, N)[None], axes)[0]
        self.keys, places, rows = [], [], []
        for number, variant in enumerate(made):
            key = F.conv2d(_wider(variant.mapped, N)[None], axes)[0]
            usable = torch.ones_like(key[0]).bool() if variant.usable is None else variant.usable
            self.keys.append(torch.where(usable, key, BARRED))
            at = usable.nonzero()
            places.append(F.pad(at, (1, 0), value=number))
            rows.append(key[:, at[:, 0], at[:, 1]].T)
        every = torch.cat(rows)
        order = torch.randperm(len(every), generator=generator).to(guide.device)
        count = -(-len(every) // PART)
        self.parts = [
            (every[some], every[some].square().sum(1), torch.cat(places)[some])
            for some in order.chunk(count)
        ]
        self.turn = 0
        self.waiting: list[tuple[float, tuple[int, int], tuple[int, int, int]]] = []

    def search(self, place: tuple[int, int], count: int, unary: Float[Tensor, "h w"]) -> None:
        """Adds the labels of lowest A' at a place, of a part of all labels."""
        rows, norms, places = self.parts[self.turn]
        self.turn = (self.turn + 1) % len(self.parts)
        costs = torch.addmv(norms, rows, self.target[:, place[0], place[1]], alpha=-2)
        found = places[costs.topk(min(count, len(costs)), largest=False)[1]]
        for number, row, col in found.tolist():
            label = number, place[0] - row, place[1] - col
            heappush(self.waiting, (-self.promise(label, unary), place, label))
        if len(self.waiting) > POOL:
            self.waiting = nsmallest(POOL // 2, self.waiting)
            heapify(self.waiting)

    def best(self, unary: Float[Tensor, "h w"]) -> tuple[tuple[int, int], tuple[int, int, int]]:
        """Takes the label out that promises most now; the place it was found for, and it."""
        while True:
            _, place, label = heappop(self.waiting)
            now = -self.promise(label, unary)
            # since it was judged others have taken what it had promised
            if not self.waiting or now <= 0.95 * self.waiting[0][0]:
                return place, label
            heappush(self.waiting, (now, place, label))

    def promise(self, label: tuple[int, int, int], unary: Float[Tensor, "h w"]) -> float:
        """How far A' would fall, where it does, if every pixel took what is better; in part."""
        number, row, col = label
        key, (h, w) = self.keys[number], unary.shape
        jump = torch.randint(SPARSE**2, (), generator=self.generator)
        down, across = divmod(int(jump), SPARSE)
        top, left = max(row, 0) + down, max(col, 0) + across
        bottom, right = min(row + key.shape[1], h), min(col + key.shape[2], w)
        if top >= bottom or left >= right:
            return 0.0
        rows, cols = slice(top, bottom, SPARSE), slice(left, right, SPARSE)
        theirs = key[:, top - row : bottom - row : SPARSE, left - col : right - col : SPARSE]
        apart = (theirs - self.target[:, rows, cols]).square_().sum(0)
        return float((unary[rows, cols] - apart).clamp_(min=0).sum())

    def places(self, unary: Float[Tensor, "h w"], count: int) -> list[tuple[int, int]]:
        """Pixels drawn with probability in proportion to what their label costs, of some."""
        some = torch.randint(unary.numel(), (8 * count,), generator=self.generator)
        some = some.to(unary.device)
        weights = unary.view(-1)[some].double()
        weights = weights + weights.max() * 1e-9 + 1e-30
        drawn = torch.multinomial(weights.cpu(), count, generator=self.generator)
        return [divmod(int(i), unary.shape[1]) for i in some[drawn.to(some.device)].tolist()]


def _axes(images: Sequence[Tensor], N: int, generator: torch.Generator) -> Tensor:
    """(AXES, k, 2 N + 1, 2 N + 1): the directions in which windows differ most."""
    side, windows = 2 * N + 1, []
    for image in images:
        wide, (h, w) = _wider(image, N), image.shape[1:]
        some = torch.randint(h * w, (SAMPLE // len(images),), generator=generator)
        rows, cols = (some // w).to(image.device), (some % w).to(image.device)
        line = torch.arange(side, device=image.device)
        windows.append(
            wide[:, (rows[:, None] + line)[:, :, None], (cols[:, None] + line)[:, None]]
            .transpose(0, 1).flatten(1)
        )  # fmt: skip
    axes = principal_axes(torch.cat(windows), AXES, generator)
    return axes.T.reshape(-1, len(images[0]), side, side).contiguous()


def _wider(image: Float[Tensor, "k h w"], N: int) -> Float[Tensor, "k y x"]:
    return F.pad(image[None], (N, N, N, N), mode="replicate")[0]


def apart_from(
    costs: list[Float[Tensor, "_ _"]], count: int, apart: int, generator: torch.Generator
) -> list[Int[Tensor, "3"]]:
    """Variant, row and column of the lowest costs that are apart from each other.

    Args:
        costs: for each variant.
        count: at most.
        apart: least distance, in rows or columns, of two of them in one variant.

    Example:
        >>> line = torch.tensor([[3.0, 1.0, 2.0]])
        >>> [x.tolist() for x in apart_from([line], 2, 2, torch.Generator())]
        [[0, 0, 1]]
    """
    found: list[Tensor] = []
    costs = [c.clone() for c in costs]
    for _ in range(count):
        best = min(float(c.min()) for c in costs)
        if best == torch.inf:
            break
        # equals, as in a flat part of a map, are drawn from
        equal = torch.cat([
            F.pad((c <= best * (1 + 1e-6)).nonzero(), (1, 0), value=number)
            for number, c in enumerate(costs)
        ])  # fmt: skip
        chosen = equal[int(torch.randint(len(equal), (), generator=generator))]
        found.append(chosen)
        number, row, col = chosen.tolist()
        rows = slice(max(row - apart + 1, 0), row + apart)
        costs[number][rows, max(col - apart + 1, 0) : col + apart] = torch.inf
    return found
