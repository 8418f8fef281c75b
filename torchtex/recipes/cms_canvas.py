"""The labeling that expansion moves lower the energy of, and all that is known of its costs.

An expansion move offers one label to the whole output at once: every pixel keeps its label or
takes the new one, whichever set of takers lowers E' most, found by a min-cut. Few pixels can gain
by most labels, so the min-cut is left with those that may, and their neighbourhood:

    unary(p) + sum over the present seams around p of B  -  A'(p, l)  >  0

A group of takers that holds no such pixel cannot gain; one that holds some may pass over others
to find a better seam, as far as the neighbourhood reaches. No move is kept unless E' falls.

`recipes/analogy_costs.py` defines the words and the energies.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut
from torchtex.cuts.seams import patch_views
from torchtex.quadratic import rowwise_sum
from torchtex.recipes.analogy import Analogy
from torchtex.recipes.analogy_costs import pair_sums, window_sums
from torchtex.recipes.labelings import Variant

REACH = 1  # pixels around those that may gain that a move may take, too


class Box(NamedTuple):
    """A rectangle: first row and column, and those after the last.

    Example:
        >>> Box(1, 2, 4, 4).wider(3, (5, 9))
        Box(top=0, left=0, bottom=5, right=7)
    """

    top: int
    left: int
    bottom: int
    right: int

    @property
    def at(self) -> tuple[slice, slice]:
        """Of an image."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def wider(self, by: int, size: tuple[int, int]) -> "Box":
        """By as many pixels on all sides, as far as it lies in an image."""
        return Box(max(self.top - by, 0), max(self.left - by, 0),
                   min(self.bottom + by, size[0]), min(self.right + by, size[1]))  # fmt: skip

    def within(self, other: "Box") -> tuple[slice, slice]:
        """Of the part of an image that another box cuts out."""
        return (slice(self.top - other.top, self.bottom - other.top),
                slice(self.left - other.left, self.right - other.left))  # fmt: skip


class _Piece(NamedTuple):
    """A variant made ready, a row for each pixel; with borders that go on."""

    rows: Tensor  # ((h + 2) (w + 2), 5, c) views
    wide: Tensor  # (k, h + 2 N, w + 2 N) mapped
    usable: Tensor | None
    shape: tuple[int, int]

    @staticmethod
    def of(variant: Variant, N: int) -> "_Piece":
        c, h, w = variant.image.shape
        image, wide = (F.pad(x[None], (n, n, n, n), mode="replicate")[0]
                       for x, n in ((variant.image, 1), (variant.mapped, N)))  # fmt: skip
        rows = patch_views(image).permute(2, 3, 0, 1).reshape(-1, 5, c).contiguous()
        return _Piece(rows, wide, variant.usable, (h, w))


class _Offer(NamedTuple):
    """A label offered to some pixels of the output.

    Args:
        label: variant, and row and column offset; as in `Labeling`.
        pixels: (n,), by number.
        shown: (n, 5, c) views of the copy there.
        gain: (n,) of taking it at no seam at all, A' less what the label now costs.
        agreement, apart: (n,), A' and |Q_l - C|^2.
        meets: (4, n), B of a pixel that takes the label and the one that keeps its own below, to
            the right, above or to the left of it.
        beside: (4, n), which of the pixels that is; -1 where it is none.
    """

    label: tuple[int, int, int]
    pixels: Tensor
    shown: Tensor
    gain: Tensor
    agreement: Tensor
    apart: Tensor
    meets: Tensor
    beside: Tensor


class Canvas:
    """A labeling and its costs; a move counts anew only what it changes.

    Pixels are numbered row by row. `right` and `down` hold B of a pixel and that to its right or
    below, 0 in the last column or row; `error` is MatchErr as of the last `refresh`.

    Args:
        problem: to be solved.
        made: variants that labels name.
        K, N, solver: as in `cms`.

    Source: Ramanarayanan and Bala 2007, section IV-B.

    Example:
        >>> from torchtex.cuts.mincut import default_solver
        >>> from torchtex.recipes.labelings import variants
        >>> z = torch.rand(3, 9, 9)
        >>> problem = Analogy.of(z, z, z)
        >>> canvas = Canvas(problem, variants(problem), 1.0, 2, default_solver())
        >>> len(canvas.expand((0, 0, 0))), canvas.energy
        (81, 0.0)
    """

    def __init__(
        self, problem: Analogy, made: tuple[Variant, ...], K: float, N: int, solver: MinCut
    ):
        like, (h, w) = problem.sources[0], problem.size
        self.size, self.K, self.N, self.solver = (h, w), K, N, solver
        self.variants, self.pieces = made, [_Piece.of(v, N) for v in made]
        self.guide = problem.guide()
        self.absent = _absent(problem, K, N)
        self.labels = torch.zeros(h, w, 3, dtype=torch.long, device=like.device)
        self.known = torch.zeros(h, w, dtype=torch.bool, device=like.device)
        self.shown = like.new_zeros(h * w, 5, len(like))
        self.unary = like.new_full((h, w), self.absent)
        self.stake = self.unary.clone()  # with the seams around each pixel
        self.apart, self.right, self.down = like.new_zeros(3, h, w)
        self.error = like.new_zeros(h, w)
        self.energy = self.absent * h * w
        self._order = torch.full((h * w,), -1, dtype=torch.long, device=like.device)
        # to the pixels below, to the right, above and to the left, as the views
        self._steps = torch.tensor([w, 1, -w, -1], device=like.device)[:, None]
        self.refresh()

    @property
    def image(self) -> Float[Tensor, "c h w"]:
        """The output now."""
        return self.shown[:, 0].T.reshape(-1, *self.size).clone()

    @property
    def full(self) -> bool:
        """Whether every pixel has a label."""
        return bool(self.known.all())

    def refresh(self) -> None:
        """MatchErr anew."""
        cost = self.K * self.apart + self.absent * (~self.known)
        pairs = pair_sums(self.right[:, :-1], self.down[:-1], self.N)
        self.error = window_sums(cost, self.N) + pairs

    def expand(self, label: tuple[int, int, int]) -> Int[Tensor, "n"]:
        """The best expansion move of a label, if E' falls; the pixels that it changed."""
        offer = self._offer(label)
        takes = offer.pixels.new_zeros(len(offer.pixels), dtype=torch.bool)
        if len(takes):
            takes = decided(*self._graph(offer), self.solver)
        if not bool(takes.any()) or not self._apply(offer, takes):
            return offer.pixels[:0]
        return offer.pixels[takes]

    def _offer(self, label: tuple[int, int, int]) -> _Offer:
        """A label, to the pixels that may gain by it."""
        number, row, col = label
        piece, N = self.pieces[number], self.N
        box = Box(row, col, row + piece.shape[0], col + piece.shape[1]).wider(0, self.size)
        outer = box.wider(N, self.size)
        copy = piece.wide[
            :,
            outer.top - row + N : outer.bottom - row + N,
            outer.left - col + N : outer.right - col + N,
        ]
        apart = (copy - self.guide[:, outer.at[0], outer.at[1]]).square().sum(0)
        inner = box.within(outer)
        agreement, apart = self.K * window_sums(apart, N)[inner], apart[inner]
        may = _spread(self.stake[box.at] > agreement, REACH)
        if piece.usable is not None:
            may &= piece.usable[box.within(Box(row, col, 0, 0))]
        rows, cols = may.nonzero().unbind(1)
        pixels = (rows + box.top) * self.size[1] + (cols + box.left)
        agreement, apart = agreement[rows, cols], apart[rows, cols]
        gain = agreement.double() - self.unary.view(-1)[pixels]
        shown, meets, beside = self._meetings(label, may, box, pixels)
        return _Offer(label, pixels, shown, gain, agreement, apart, meets, beside)

    def _meetings(
        self, label: tuple[int, int, int], may: Tensor, box: Box, pixels: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What a label shows at some pixels, seams with those around them, and which those are."""
        number, row, col = label
        piece, (h, w) = self.pieces[number], self.size
        outer = box.wider(1, self.size)
        near = may.new_zeros(outer.bottom - outer.top, outer.right - outer.left)
        near[box.within(outer)] = may
        rows, cols = _spread(near, 1).nonzero().unbind(1)
        rows, cols = rows + outer.top, cols + outer.left
        places = rows * w + cols
        width = piece.shape[1] + 2
        views = piece.rows.index_select(0, (rows - (row - 1)) * width + (cols - (col - 1)))
        unlike = (views - self.shown.index_select(0, places)).square().sum(-1).sqrt()
        unlike = unlike.double() * self.known.view(-1)[places, None]
        order = self._order
        order[places] = torch.arange(len(places), device=places.device)
        own = order[pixels]
        there = pixels + self._steps  # (4, n)
        col_of = pixels % w
        inside = torch.stack([pixels < (h - 1) * w, col_of < w - 1, pixels >= w, col_of > 0])
        which = order[torch.where(inside, there, pixels)]
        ways = torch.arange(4, device=places.device)[:, None]
        meets = (unlike[which, 0] + unlike[which, 1 + (ways + 2) % 4]) * inside
        order[places] = -1
        order[pixels] = torch.arange(len(pixels), device=places.device)
        beside = torch.where(inside, order[torch.where(inside, there, pixels)], -1)
        order[pixels] = -1
        return views[own], meets, beside

    def _present(self, pixels: Tensor) -> Tensor:
        """(4, n): B of pixels and those below, to the right, above and to the left."""
        down, right = self.down.view(-1), self.right.view(-1)
        return torch.stack([down[pixels], right[pixels], down[pixels - self.size[1]],
                            right[pixels - 1]])  # fmt: skip

    def _graph(self, offer: _Offer) -> tuple[Tensor, Tensor, Tensor]:
        """Gain of keeping over taking at each pixel; pairs; and a capacity for each of them."""
        stays = self._present(offer.pixels).double()
        joined = offer.beside >= 0
        gain = offer.gain + torch.where(joined, 0, offer.meets - stays).sum(0)
        way, first = joined[:2].nonzero().unbind(1)
        second = offer.beside[way, first]
        stay, leave, enter = (
            stays[way, first],
            offer.meets[way, first],
            offer.meets[way + 2, second],
        )
        caps = _truncated(stay, enter, leave, gain, first, second)
        return gain, torch.stack([first, second]), caps

    def _apply(self, offer: _Offer, takes: Bool[Tensor, "n"]) -> bool:
        """Lets pixels take the label if that lowers E'; whether it did."""
        w = self.size[1]
        pixels, beside = offer.pixels[takes], offer.beside[:, takes]
        both = (beside >= 0) & takes[beside]  # the pair shows one label: no seam
        new = torch.where(both, 0, offer.meets[:, takes])
        lines, ends = (self.down.view(-1), self.right.view(-1)), (pixels - w, pixels - 1)
        once = torch.ones_like(both)
        once[2:] = ~both[2:]
        change = torch.where(once, new - self._present(pixels).double(), 0)
        step = float(rowwise_sum(offer.gain[takes])) + float(rowwise_sum(change.flatten()))
        if not step < 0:
            return False
        self.energy += step
        new = new.to(self.unary.dtype)
        for way, line in enumerate(lines):
            line[pixels] = new[way]
            other = ends[way] >= 0 if way == 0 else pixels % w > 0
            line[ends[way][other]] = new[way + 2][other]
        unary, apart, known = (x.view(-1) for x in (self.unary, self.apart, self.known))
        unary[pixels], apart[pixels] = offer.agreement[takes], offer.apart[takes]
        known[pixels], self.shown[pixels] = True, offer.shown[takes]
        self.labels.view(-1, 3)[pixels] = self.labels.new_tensor(offer.label)
        around = torch.cat([pixels, ((pixels + self._steps) % len(unary)).flatten()])
        self.stake.view(-1)[around] = unary[around] + self._present(around).sum(0)
        return True


def _truncated(
    stay: Tensor, enter: Tensor, leave: Tensor, gain: Tensor, first: Tensor, second: Tensor
) -> Tensor:
    """Capacity of each pair; the rest of its costs goes to the gains of its first and second.

    Where the pair is not submodular, unlike labels are taken to cost more than they do.
    """
    lack = (stay - enter - leave).clamp(min=0) / 2
    enter, leave = enter + lack, leave + lack
    gain.index_add_(0, first, leave - stay).index_add_(0, second, -leave)
    return (enter + leave - stay).clamp(min=0)


def decided(
    gain: Float[Tensor, "n"], pairs: Int[Tensor, "2 e"], caps: Float[Tensor, "e"], solver: MinCut
) -> Bool[Tensor, "n"]:
    """Minimum of the sum of gain where True, and of capacities from False pixels to True ones.

    Example:
        >>> from torchtex.cuts.mincut import default_solver
        >>> pairs, caps = torch.tensor([[0], [1]]), torch.tensor([1.0])
        >>> decided(torch.tensor([2.0, -3.0]), pairs, caps, default_solver()).tolist()
        [False, True]
    """
    used = caps > 0
    caps, zeros = caps[used], torch.zeros_like
    return solver(
        torch.stack([zeros(gain), gain], 1),
        pairs[:, used].T,
        torch.stack([caps, zeros(caps)], 1),
    )


def _spread(mask: Bool[Tensor, "h w"], reach: int) -> Bool[Tensor, "h w"]:
    """Also the pixels above, below and beside, step by step."""
    for _ in range(reach):
        wider = mask.clone()
        wider[1:] |= mask[:-1]
        wider[:-1] |= mask[1:]
        wider[:, 1:] |= mask[:, :-1]
        wider[:, :-1] |= mask[:, 1:]
        mask = wider
    return mask


def _absent(problem: Analogy, K: float, N: int) -> float:
    """A cost of no label that is above that of any label, its pairs included."""

    def span(images: list[Tensor]) -> float:
        low = min(float(x.min()) for x in images)
        return len(images[0]) * (max(float(x.max()) for x in images) - low) ** 2

    guides = [problem.guide(), *(problem.guides(j) for j in range(len(problem.sources)))]
    most = K * (2 * N + 1) ** 2 * span(guides) + 8 * span(list(problem.sources)) ** 0.5
    # a power of two, exact in any precision
    return 2.0 ** math.ceil(math.log2(1 + 2 * most))
