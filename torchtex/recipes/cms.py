"""Constrained synthesis by energy minimisation (CMS): expansion moves where the output is worst.

The output begins with no labels, which costs more than any label. Then, again and again:

    1. p is the pixel where MatchErr is highest;
    2. the labels of lowest Imprv(l) = A'(p, l) + sum over N_p of |S_l - O|^2 are found, by
       Fourier transforms, a few that are apart from each other;
    3. each of them is offered to the whole output in an expansion move, kept if E' falls;
    4. if they lowered E' by too little, the next worst pixel is tried; and after a few pixels
       in a row at which this was so the run ends.

`recipes/analogy.py` defines the words and the energies, in the units of the images.
Source: Ramanarayanan and Bala 2007, Constrained texture synthesis via energy minimization.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut, cut_grid, default_solver
from torchtex.cuts.seams import patch_views, present_seams
from torchtex.inputs import check_seed
from torchtex.patches import SsdSearch, ssd_search
from torchtex.quadratic import rowwise_sum, threads
from torchtex.recipes.analogy import (
    Analogy,
    Energies,
    Labeling,
    Variant,
    check_window,
    energy,
    pair_sums,
    source_field,
    variants,
    window_sums,
)
from torchtex.recipes.montage import Montage, Stage

SPARSE = 0.4  # of the pixels of a rectangle still open: below it a list of edges is quicker
ROUNDS = 4  # of deciding pixels that no neighbour can sway


@dataclass(frozen=True)
class CmsMove:
    """One expansion move that was kept.

    Args:
        place: row and column of the pixel that was to be improved.
        label: variant, and row and column offset; as in `Labeling`.
        changed: pixels that took the label.
        energy: E' after it, with the price of the pixels that have no label yet.
    """

    place: tuple[int, int]
    label: tuple[int, int, int]
    changed: int
    energy: float


@dataclass(frozen=True)
class CmsResult:
    """What `cms` returns.

    Args:
        montage: texture, sources and patches; one patch per label.
        labeling: the labels.
        energies: what they cost, counted anew.
        moves: all that were kept, in order.
        searches: pixels for which labels were searched.
        tried: expansion moves that were solved, kept or not.
    """

    montage: Montage
    labeling: Labeling
    energies: Energies
    moves: tuple[CmsMove, ...]
    searches: int
    tried: int

    @property
    def texture(self) -> Float[Tensor, "c h w"]:
        """The output."""
        return self.montage.texture


def cms(
    problem: Analogy,
    *,
    K: float = 1.0,
    N: int = 3,
    candidates: int = 5,
    apart: int = 20,
    history: int = 8,
    tolerance: float | None = None,
    turns: bool = True,
    mirrors: bool = False,
    solver: MinCut | None = None,
    seed: int = 0,
    max_moves: int | None = None,
    on_step: Callable[[Stage], None] | None = None,
) -> CmsResult:
    """The output of an analogy: few seams, and a mapped output that looks like the constraint.

    E' never rises. A large K asks for the constraint, a small one for fewer seams; a large N for
    large structures, a small one for curves and details. What suited photographs of about
    300 pixels a side: K = 0.05, N = 3 for maps of regions (texture-by-numbers), K = 2, N = 2 for
    artistic filters, K = 6, N = 2 for texture transfer, and K = 20, N = 2 for detail, there with
    `analogy.back_projected` afterwards. In a scene that has an up and a down, `turns=False`
    looks better, and is quicker; a history of 16 or 30 goes on where some places cannot be met.

    Args:
        K: weight of the constraint.
        N: reach of the windows, of 2 N + 1 pixels a side.
        candidates: labels tried per search.
        apart: least distance, in rows or columns, of two of them in one variant.
        history: pixels tried in vain in a row that end the run.
        tolerance: E' must fall by more for a search to have helped; None for 5 (K + 2).
        turns, mirrors: labels that turn or mirror the source.
        solver: of the min-cuts; None for the first one that is installed.
        seed: of choices among equals.
        max_moves: kept moves at most, once every pixel has a label.

    Raises:
        ValueError: an option that makes no sense.
        ImportError: no min-cut solver is installed.

    Source: Ramanarayanan and Bala 2007, section IV-C.

    Example:
        >>> z = torch.rand(3, 16, 16)
        >>> result = cms(Analogy.of(z, z, z), N=2, tolerance=0.0)
        >>> bool((result.texture == z).all())
        True
    """
    started = time.perf_counter()
    check_window(K, N)
    _check(candidates, apart, history, tolerance, seed, max_moves)
    solver = default_solver() if solver is None else solver
    limit = 5 * (K + 2) if tolerance is None else tolerance
    with threads(1):
        run = _Run(
            Canvas(problem, variants(problem, turns=turns, mirrors=mirrors), K, N, solver),
            candidates, apart, torch.Generator().manual_seed(seed), on_step,
        )  # fmt: skip
        run.go(limit, history, max_moves)
        labeling = Labeling(run.canvas.labels, run.canvas.variants)
        energies = energy(problem, labeling, K=K, N=N)
    settings = {
        "recipe": "cms", "K": K, "N": N, "candidates": candidates, "apart": apart,
        "history": history, "tolerance": limit, "turns": turns, "mirrors": mirrors,
        "max_moves": max_moves, "weights": list(problem.weights),
        "size": list(problem.size), "sources": [list(s) for s in problem.shapes],
    }  # fmt: skip
    field = source_field(labeling)
    montage = Montage(
        field.apply(list(problem.sources)), field, patch_numbers(labeling.labels, run.moves),
        time.perf_counter() - started, seed, settings,
    )  # fmt: skip
    return CmsResult(montage, labeling, energies, tuple(run.moves), run.searches, run.tried)


class _Box(NamedTuple):
    """A rectangle of the output: first row and column, and those after the last."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def at(self) -> tuple[slice, slice]:
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def wider(self, by: int, size: tuple[int, int]) -> "_Box":
        return _Box(max(self.top - by, 0), max(self.left - by, 0),
                    min(self.bottom + by, size[0]), min(self.right + by, size[1]))  # fmt: skip

    def joined(self, other: "_Box | None") -> "_Box":
        if other is None:
            return self
        return _Box(min(self.top, other.top), min(self.left, other.left),
                    max(self.bottom, other.bottom), max(self.right, other.right))  # fmt: skip

    def within(self, other: "_Box") -> tuple[slice, slice]:
        return (slice(self.top - other.top, self.bottom - other.top),
                slice(self.left - other.left, self.right - other.left))  # fmt: skip


@dataclass(frozen=True)
class _Piece:
    """A variant made ready: views of its pixels, mapped pixels with a margin, searches."""

    views: Tensor
    wide: Tensor
    by_mapped: SsdSearch
    by_image: SsdSearch
    by_both: SsdSearch
    shape: tuple[int, int]

    @staticmethod
    def of(variant: Variant, K: float, N: int) -> "_Piece":
        image, mapped = (F.pad(x[None], (N, N, N, N), mode="replicate")[0]
                         for x in (variant.image, variant.mapped))  # fmt: skip
        both = torch.cat([image, mapped * K**0.5])
        shape = variant.image.shape[1], variant.image.shape[2]
        return _Piece(patch_views(variant.image), mapped, ssd_search(mapped), ssd_search(image),
                      ssd_search(both), shape)  # fmt: skip


class _Offer(NamedTuple):
    """A label offered to the rectangle that its copy of the source covers."""

    label: tuple[int, int, int]
    box: _Box
    views: Tensor  # (5, c, h, w) of the copy
    apart: Tensor  # (h, w), |Q_l - C|^2
    agreement: Tensor  # (h, w), A'


class Canvas:
    """The labeling now, and all that is known of its costs; a move updates what it changed."""

    def __init__(
        self, problem: Analogy, made: tuple[Variant, ...], K: float, N: int, solver: MinCut
    ):
        like, (h, w) = problem.sources[0], problem.size
        self.size, self.K, self.N, self.solver = (h, w), K, N, solver
        self.variants, self.pieces = made, [_Piece.of(v, K, N) for v in made]
        self.guide = problem.guide()
        self.absent = _absent(problem, K, N)
        self.labels = torch.zeros(h, w, 3, dtype=torch.long, device=like.device)
        self.known = torch.zeros(h, w, dtype=torch.bool, device=like.device)
        self.unary = like.new_full((h, w), self.absent)
        self.views = like.new_zeros(5, len(like), h, w)
        self.apart = like.new_zeros(h, w)
        self.right, self.down = like.new_zeros(h, w - 1), like.new_zeros(h - 1, w)
        self.error = like.new_zeros(h, w)
        self.energy = self.absent * h * w
        self.refresh(_Box(0, 0, h, w))

    def refresh(self, box: _Box) -> None:
        """MatchErr anew for the pixels whose windows reach into a box."""
        N, size = self.N, self.size
        inner = box.wider(N, size)
        outer = inner.wider(N, size)
        rows, cols = outer.at
        cost = self.K * self.apart[rows, cols] + self.absent * (~self.known[rows, cols])
        pairs = pair_sums(
            self.right[rows, outer.left : outer.right - 1],
            self.down[outer.top : outer.bottom - 1, cols],
            N,
        )
        self.error[inner.at] = (window_sums(cost, N) + pairs)[inner.within(outer)]

    def costs(self, row: int, col: int) -> list[Float[Tensor, "h w"]]:
        """Imprv of the labels that show a pixel of each variant at a place; by that pixel."""
        N = self.N
        side = 2 * N + 1
        part = _Box(row, col, row + 1, col + 1).wider(N, self.size)
        into = (..., *part.within(_Box(row - N, col - N, row + N + 1, col + N + 1)))
        inside = self.known.new_zeros(side, side)
        inside[into] = True
        known = inside.clone()
        known[into] = self.known[part.at]
        guide = self.guide.new_zeros(len(self.guide), side, side)
        guide[into] = self.guide[:, part.top : part.bottom, part.left : part.right]
        shown = self.views.new_zeros(self.views.shape[1], side, side)
        shown[into] = self.views[0][:, part.top : part.bottom, part.left : part.right]
        if bool((known == inside).all()):
            both = torch.cat([shown, guide * self.K**0.5])[None]
            return [piece.by_both(both, inside)[0] for piece in self.pieces]
        found = [self.K * piece.by_mapped(guide[None], inside)[0] for piece in self.pieces]
        if bool(known.any()):
            for costs, piece in zip(found, self.pieces, strict=True):
                costs += piece.by_image(shown[None], known)[0]
        return found

    def offer(self, label: tuple[int, int, int]) -> _Offer:
        number, row, col = label
        piece, N = self.pieces[number], self.N
        box = _Box(row, col, row + piece.shape[0], col + piece.shape[1]).wider(0, self.size)
        outer = box.wider(N, self.size)
        copy = piece.wide[
            :,
            outer.top - row + N : outer.bottom - row + N,
            outer.left - col + N : outer.right - col + N,
        ]
        apart = (copy - self.guide[:, outer.at[0], outer.at[1]]).square().sum(0)
        inner = box.within(outer)
        agreement = self.K * window_sums(apart, N)[inner]
        rows, cols = box.within(_Box(row, col, 0, 0))
        return _Offer(label, box, piece.views[:, :, rows, cols], apart[inner], agreement)

    def expand(self, label: tuple[int, int, int]) -> tuple[int, _Box | None]:
        """The best expansion move of a label, if E' falls: pixels changed, and where."""
        offer = self.offer(label)
        takes = _solve(*self._graph(offer), self.solver)
        same = (self.labels[offer.box.at] == self.labels.new_tensor(label)).all(-1)
        takes = takes & ~(same & self.known[offer.box.at])
        changed = _extent(takes, offer.box)
        return (0, None) if changed is None else self._apply(offer, takes, changed)

    def _graph(self, offer: _Offer) -> tuple[Tensor, Tensor, Tensor]:
        """Gain of keeping over taking at each pixel, and capacities to the right and down."""
        (rows, cols), new = offer.box.at, offer.views
        known = self.known[rows, cols]
        gain = (offer.agreement - self.unary[rows, cols]).double()
        unlike = (self.views[:, :, rows, cols] - new).square().sum(1).sqrt().mul_(known).double()
        right = self.right[rows, cols.start : cols.stop - 1].double()
        down = self.down[rows.start : rows.stop - 1, cols].double()
        here = unlike[0]
        across = _truncated(
            right,
            (here + unlike[2])[:, :-1],
            (here + unlike[4])[:, 1:],
            gain[:, :-1],
            gain[:, 1:],
        )
        below = _truncated(
            down, (here + unlike[1])[:-1], (here + unlike[3])[1:], gain[:-1], gain[1:]
        )
        self._rim(offer, gain)
        return gain, across, below

    def _rim(self, offer: _Offer, gain: Tensor) -> None:
        """Adds the pairs of a pixel inside the rectangle and one outside, which keeps its label."""
        box, (h, w), (rows, cols) = offer.box, self.size, offer.box.at
        # our line, that across, the present costs, and the views that look there and back
        every = slice(None)
        sides: list[tuple[Tensor, tuple[Any, Any], tuple[Any, Any], Tensor, int, int]] = []
        if box.bottom < h:
            present = self.down[box.bottom - 1, cols]
            sides.append((gain[-1], (-1, every), (box.bottom, cols), present, 1, 3))
        if box.right < w:
            present = self.right[rows, box.right - 1]
            sides.append((gain[:, -1], (every, -1), (rows, box.right), present, 2, 4))
        if box.top > 0:
            present = self.down[box.top - 1, cols]
            sides.append((gain[0], (0, every), (box.top - 1, cols), present, 3, 1))
        if box.left > 0:
            present = self.right[rows, box.left - 1]
            sides.append((gain[:, 0], (every, 0), (rows, box.left - 1), present, 4, 2))
        for line, ours, theirs, present, ahead, back in sides:
            here, there = (
                offer.views[:, :, ours[0], ours[1]],
                self.views[:, :, theirs[0], theirs[1]],
            )
            cost = (here[0] - there[back]).square().sum(0).sqrt()
            cost = cost + (here[ahead] - there[0]).square().sum(0).sqrt()
            line += cost * self.known[theirs] - present

    def _apply(self, offer: _Offer, takes: Tensor, changed: _Box) -> tuple[int, _Box | None]:
        around = changed.wider(1, self.size)
        (rows, cols), part = changed.at, changed.within(offer.box)
        takes = takes[part]
        into = changed.within(around)
        seen = self.views[:, :, around.at[0], around.at[1]].clone()
        seen[:, :, into[0], into[1]] = torch.where(
            takes, offer.views[:, :, part[0], part[1]], seen[:, :, into[0], into[1]]
        )
        known = self.known[around.at].clone()
        known[into] |= takes
        right, down = present_seams(seen)
        right = right * (known[:, :-1] & known[:, 1:])
        down = down * (known[:-1] & known[1:])
        to_right = (around.at[0], slice(around.left, around.right - 1))
        to_below = (slice(around.top, around.bottom - 1), around.at[1])
        agreement = offer.agreement[part]
        steps = (
            (agreement.double() - self.unary[rows, cols])[takes],
            (right.double() - self.right[to_right]).flatten(),
            (down.double() - self.down[to_below]).flatten(),
        )
        step = sum(float(rowwise_sum(x)) for x in steps)
        if not step < 0:
            return 0, None
        self.energy += step
        self.right[to_right], self.down[to_below] = right, down
        self.views[:, :, around.at[0], around.at[1]] = seen
        self.known[around.at] = known
        for own, new in ((self.unary, agreement), (self.apart, offer.apart[part])):
            own[rows, cols] = torch.where(takes, new, own[rows, cols])
        self.labels[rows, cols] = torch.where(
            takes[..., None], self.labels.new_tensor(offer.label), self.labels[rows, cols]
        )
        return int(takes.sum()), changed


class _Run:
    """The loop, and its records."""

    def __init__(
        self,
        canvas: Canvas,
        candidates: int,
        apart: int,
        generator: torch.Generator,
        on_step: Callable[[Stage], None] | None,
    ):
        self.canvas, self.candidates, self.apart = canvas, candidates, apart
        self.generator, self.on_step = generator, on_step
        self.moves: list[CmsMove] = []
        self.searches = self.tried = 0

    def go(self, tolerance: float, history: int, max_moves: int | None) -> None:
        canvas = self.canvas
        tired = torch.zeros_like(canvas.known)
        vain = 0
        while True:
            full = bool(canvas.known.all())
            spent = max_moves is not None and len(self.moves) >= max_moves
            if full and (vain >= history or spent):
                return
            place = self._worst(~tired if full else ~canvas.known)
            if place is None:
                return
            before = canvas.energy
            box = self._improve(place, max_moves if full else None)
            if box is not None:  # what failed near here may now succeed
                canvas.refresh(box)
                tired[box.wider(canvas.N, canvas.size).at] = False
            if full and before - canvas.energy <= tolerance:
                near = _Box(place[0], place[1], place[0] + 1, place[1] + 1)
                tired[near.wider(canvas.N, canvas.size).at] = True
                vain += 1
            else:
                vain = 0
            self._tell(place, full)

    def _worst(self, allowed: Bool[Tensor, "h w"]) -> tuple[int, int] | None:
        error = torch.where(allowed, self.canvas.error, 0)
        worst = error.max()
        if not float(worst) > 0:
            return None
        row, col = self._one_of((error >= worst).nonzero())
        return row, col

    def _improve(self, place: tuple[int, int], max_moves: int | None) -> _Box | None:
        """Expansion moves of the best labels for a place; where they changed the output."""
        self.searches += 1
        box = None
        for label in self._found(place):
            if max_moves is not None and len(self.moves) >= max_moves:
                break
            self.tried += 1
            changed, where = self.canvas.expand(label)
            if where is not None:
                self.moves.append(CmsMove(place, label, changed, self.canvas.energy))
                box = where.joined(box)
        return box

    def _found(self, place: tuple[int, int]) -> list[tuple[int, int, int]]:
        costs = self.canvas.costs(*place)
        labels: list[tuple[int, int, int]] = []
        for _ in range(self.candidates):
            best = min(float(c.min()) for c in costs)
            if best == torch.inf:
                break
            # equals, as in a flat part of a map, are drawn from
            equal = [(c <= best * (1 + 1e-6)).nonzero() for c in costs]
            ends = torch.tensor([0, *(len(e) for e in equal)]).cumsum(0).tolist()
            drawn = int(torch.randint(ends[-1], (), generator=self.generator))
            number = next(i for i, (a, b) in enumerate(pairwise(ends)) if a <= drawn < b)
            row, col = (int(x) for x in equal[number][drawn - ends[number]])
            labels.append((number, place[0] - row, place[1] - col))
            reach = _Box(row, col, row + 1, col + 1)
            size = costs[number].shape[0], costs[number].shape[1]
            costs[number][reach.wider(max(self.apart - 1, 0), size).at] = torch.inf
        return labels

    def _one_of(self, places: Int[Tensor, "n 2"]) -> tuple[int, int]:
        drawn = int(torch.randint(len(places), (), generator=self.generator))
        return int(places[drawn, 0]), int(places[drawn, 1])

    def _tell(self, place: tuple[int, int], full: bool) -> None:
        if self.on_step is None:
            return
        canvas = self.canvas
        share = float(canvas.known.double().mean())
        done = 0.2 * share if not full else 1 - 0.8 / (1 + self.searches / 50)
        detail = f"E' {canvas.energy:.6g}, {len(self.moves)} moves, worst at {place[0]},{place[1]}"
        note = "improving" if full else "filling"
        self.on_step(Stage(done, note, canvas.views[0].clone(), detail))


def _truncated(stay: Tensor, enter: Tensor, leave: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Capacity of each pair; the rest of its costs goes to the gains of its first and second.

    Where the pair is not submodular, unlike labels are taken to cost more than they do.
    """
    lack = (stay - enter - leave).clamp(min=0) / 2
    enter, leave = enter + lack, leave + lack
    first += leave - stay
    second -= leave
    return (enter + leave - stay).clamp(min=0)


def _solve(
    gain: Float[Tensor, "h w"],
    right: Float[Tensor, "h w_"],
    down: Float[Tensor, "h_ w"],
    solver: MinCut,
) -> Bool[Tensor, "h w"]:
    """Minimum of sum of gain where True, and capacities from False pixels to True ones.

    Pixels that no neighbour can sway are decided first; the min-cut is left with the others.
    """
    no, yes = torch.zeros_like(gain, dtype=torch.bool), torch.zeros_like(gain, dtype=torch.bool)
    bent = gain
    for _ in range(ROUNDS):
        bent, out, into = _bent(gain, right, down, no, yes)
        no_now, yes_now = no | (~yes & (bent >= out)), yes | (~no & (-bent > into))
        done = bool((no_now == no).all()) and bool((yes_now == yes).all())
        no, yes = no_now, yes_now & ~no_now
        if done:
            break
    free = ~(no | yes)
    count = int(free.sum())
    if not count:
        return yes
    bent, _, _ = _bent(gain, right, down, no, yes)
    if count > SPARSE * free.numel():
        return _whole(gain, right, down, solver)
    index = torch.full(gain.shape, -1, dtype=torch.long, device=gain.device)
    index[free] = torch.arange(count, device=gain.device)
    both_right, both_down = free[:, :-1] & free[:, 1:], free[:-1] & free[1:]
    tails = torch.cat([index[:, :-1][both_right], index[:-1][both_down]])
    heads = torch.cat([index[:, 1:][both_right], index[1:][both_down]])
    caps = torch.cat([right[both_right], down[both_down]])
    used = caps > 0
    labels = solver(
        _two(bent[free]), torch.stack([tails[used], heads[used]], 1), _two(caps[used], True)
    )
    yes = yes.clone()
    yes[free] = labels
    return yes


def _whole(gain: Tensor, right: Tensor, down: Tensor, solver: MinCut) -> Tensor:
    return cut_grid(_two(gain), _two(right, True), _two(down, True), solver)


def _two(x: Tensor, first: bool = False) -> Tensor:
    """(..., 2): the values and zeros, or zeros and the values."""
    zeros = torch.zeros_like(x)
    return torch.stack([x, zeros] if first else [zeros, x], -1)


def _bent(
    gain: Tensor, right: Tensor, down: Tensor, no: Tensor, yes: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gains given the pixels decided, and the open capacities out of and into each pixel."""
    bent, out, into = gain.clone(), torch.zeros_like(gain), torch.zeros_like(gain)
    for axis, caps in ((1, right), (0, down)):
        n = gain.shape[axis]
        tail, head = (x.narrow(axis, i, n - 1) for x, i in ((no, 0), (yes, 1)))
        # a tail that is False, a head that is True
        bent.narrow(axis, 1, n - 1).add_(caps * tail)
        bent.narrow(axis, 0, n - 1).sub_(caps * head)
        free_tail = ~(no.narrow(axis, 0, n - 1) | yes.narrow(axis, 0, n - 1))
        free_head = ~(no.narrow(axis, 1, n - 1) | yes.narrow(axis, 1, n - 1))
        open_caps = caps * (free_tail & free_head)
        out.narrow(axis, 0, n - 1).add_(open_caps)
        into.narrow(axis, 1, n - 1).add_(open_caps)
    return bent, out, into


def _extent(mask: Bool[Tensor, "h w"], box: _Box) -> _Box | None:
    """The box of the True pixels of a mask of a box, or None."""
    rows, cols = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    if not len(rows):
        return None
    return _Box(box.top + int(rows[0]), box.left + int(cols[0]),
                box.top + int(rows[-1]) + 1, box.left + int(cols[-1]) + 1)  # fmt: skip


def _absent(problem: Analogy, K: float, N: int) -> float:
    """A cost of no label that is above that of any label, its pairs included."""

    def span(images: list[Tensor]) -> float:
        low = min(float(x.min()) for x in images)
        return len(images[0]) * (max(float(x.max()) for x in images) - low) ** 2

    guides = [problem.guide(), *(problem.guides(j) for j in range(len(problem.sources)))]
    most = K * (2 * N + 1) ** 2 * span(guides) + 8 * span(list(problem.sources)) ** 0.5
    # a power of two, exact in any precision
    return 2.0 ** math.ceil(math.log2(1 + 2 * most))


def patch_numbers(labels: Int[Tensor, "h w 3"], moves: list[CmsMove]) -> Int[Tensor, "h w"]:
    """A number for each label, in the order of the first moves that laid them."""
    order = {label: i for i, label in reversed(list(enumerate(m.label for m in moves)))}
    used, which = labels.flatten(0, 1).unique(dim=0, return_inverse=True)
    rank = torch.tensor([order[(a, b, c)] for a, b, c in used.tolist()], device=labels.device)
    return rank.argsort().argsort()[which].view(labels.shape[:2])


def _check(
    candidates: int,
    apart: int,
    history: int,
    tolerance: float | None,
    seed: int,
    max_moves: int | None,
) -> None:
    for name, value in (("candidates", candidates), ("apart", apart), ("history", history)):
        if value < 1:
            raise ValueError(f"{name}={value} must be at least 1")
    if tolerance is not None and not 0 <= tolerance < float("inf"):
        raise ValueError(f"tolerance={tolerance} must be at least 0, and finite; or None")
    if max_moves is not None and max_moves < 0:
        raise ValueError(f"max_moves={max_moves} must be at least 0, or None for no limit")
    check_seed(seed)
