"""Constrained synthesis by energy minimisation (CMS): expansion moves where the output is worst.

The output begins with no labels, which costs more than any label. The paper's way, that of
`screened=False`:

    1. p is the pixel where MatchErr is highest;
    2. the labels of lowest Imprv(l) = A'(p, l) + sum over N_p of |S_l - O|^2 are found, by
       Fourier transforms, a few that are apart from each other;
    3. each of them is offered to the whole output in an expansion move, kept if E' falls;
    4. if they lowered E' by too little, the next worst pixel is tried; and after a few pixels
       in a row at which this was so the run ends.

But the pixels where MatchErr is highest are often those that no label can mend, and a label that
is best in one small window is hardly better than any other for the rest of the output, to which
it is offered as well. At equal time labels drawn at random then lower E' as far. So, by default:

    1. p is drawn, with probability in proportion to A'(p, L(p)), from some pixels;
    2. the labels of lowest A'(p, l) are found among a part of all labels, in windows reduced to
       a few axes, and judged by what the whole output would gain by each of them (`Prospects`);
    3. of all labels found up to now and not yet offered, the one that promises most is offered;
    4. if `candidates` moves lowered E' by too little, and so did the next, and so on, the run ends.

`analogy_costs.py` defines the energies, in the units of the images.
Source: Ramanarayanan and Bala 2007, Constrained texture synthesis via energy minimization.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.inputs import check_seed
from torchtex.quadratic import threads
from torchtex.recipes.analogy import Analogy
from torchtex.recipes.analogy_costs import Energies, check_window, energy
from torchtex.recipes.cms_canvas import Canvas
from torchtex.recipes.cms_search import Improvement, Prospects, apart_from
from torchtex.recipes.labelings import Labeling, source_field, variants
from torchtex.recipes.montage import Montage, Stage

PLACES = 2  # searched before a move
DRAWN = 8  # places at a time


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
    screened: bool = True,
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
    300 pixels a side: K = 0.05, N = 3 for maps of regions (texture-by-numbers), K = 0.5, N = 3 for
    artistic filters, K = 6, N = 2 for texture transfer, and K = 20, N = 2 with the paper's
    tolerance for detail, and `detail.back_projected` afterwards. In a scene that has an up and a
    down, `turns=False` looks better, and is quicker. A lower tolerance goes on for longer.

    Args:
        K: weight of the constraint.
        N: reach of the windows, of 2 N + 1 pixels a side.
        candidates: labels found per search.
        apart: least distance, in rows or columns, of two of them in one variant; if not screened.
        history: pixels tried in vain in a row that end the run, with all their candidates; if
            screened, groups of as many moves.
        tolerance: E' must fall by more for them to have helped; None for the paper's 5 (K + 2),
            and K + 2 if screened.
        screened: offer the labels of the best prospects; False for the paper's way.
        turns, mirrors: labels that turn or mirror the source.
        solver: of the min-cuts; None for the first one that is installed.
        seed: of all that is drawn.
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
    limit = (K + 2 if screened else 5 * (K + 2)) if tolerance is None else tolerance
    with threads(1):
        canvas = Canvas(problem, variants(problem, turns=turns, mirrors=mirrors), K, N, solver)
        generator = torch.Generator().manual_seed(seed)
        run = _Run(canvas, candidates, apart, generator, on_step)
        (run.screened if screened else run.as_in_the_paper)(limit, history, max_moves)
        labeling = Labeling(canvas.labels, canvas.variants)
        energies = energy(problem, labeling, K=K, N=N)
    settings = {
        "recipe": "cms", "K": K, "N": N, "candidates": candidates, "apart": apart,
        "history": history, "tolerance": limit, "screened": screened, "turns": turns,
        "mirrors": mirrors, "max_moves": max_moves, "weights": list(problem.weights),
        "size": list(problem.size), "sources": [list(s) for s in problem.shapes],
    }  # fmt: skip
    field = source_field(labeling)
    montage = Montage(
        field.apply(list(problem.sources)), field, patch_numbers(labeling.labels, run.moves),
        time.perf_counter() - started, seed, settings,
    )  # fmt: skip
    return CmsResult(montage, labeling, energies, tuple(run.moves), run.searches, run.tried)


class _Run:
    """The loop, both ways, and its records."""

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
        self.searches = self.tried = self.vain = 0

    def screened(self, tolerance: float, history: int, max_moves: int | None) -> None:
        """Offers the label of the best prospects, again and again."""
        canvas = self.canvas
        prospects = Prospects(
            canvas.variants, canvas.guide, canvas.K, canvas.N, self.generator
        )  # fmt: skip
        places: list[tuple[int, int]] = []
        full, before = False, canvas.energy
        while canvas.energy != 0 and not (full and self._ended(history, max_moves)):
            for _ in range(PLACES):
                places = places or prospects.places(canvas.unary, DRAWN)
                prospects.search(places.pop(), self.candidates, canvas.unary)
            self.searches += PLACES
            self._offer(*prospects.best(canvas.unary))
            full = full or canvas.full
            if self.tried % self.candidates == 0:
                self.vain = self.vain + 1 if full and before - canvas.energy <= tolerance else 0
                before = canvas.energy
                self._tell(full)

    def as_in_the_paper(self, tolerance: float, history: int, max_moves: int | None) -> None:
        """Offers the labels that improve the worst place, again and again."""
        canvas = self.canvas
        search = Improvement.of(canvas.variants, canvas.K, canvas.N)
        tired = torch.zeros_like(canvas.known)
        while True:
            full = canvas.full
            canvas.refresh()
            place = self._worst(~tired if full else ~canvas.known)
            if place is None or (full and self._ended(history, max_moves)):
                return
            before, changed = canvas.energy, torch.zeros_like(canvas.known)
            costs = search(place, canvas.guide, canvas.image, canvas.known)
            self.searches += 1
            for found in apart_from(costs, self.candidates, self.apart, self.generator):
                number, row, col = found.tolist()
                if not (full and self._spent(max_moves)):
                    label = number, place[0] - row, place[1] - col
                    changed.view(-1)[self._offer(place, label)] = True
            tired &= ~_widened(changed, canvas.N)  # what failed near here may now succeed
            if full and before - canvas.energy <= tolerance:
                changed.zero_()[place] = True
                tired |= _widened(changed, canvas.N)
                self.vain += 1
            else:
                self.vain = 0
            self._tell(full)

    def _offer(self, place: tuple[int, int], label: tuple[int, int, int]) -> Int[Tensor, "n"]:
        """An expansion move; the pixels that it changed."""
        self.tried += 1
        changed = self.canvas.expand(label)
        if len(changed):
            self.moves.append(CmsMove(place, label, len(changed), self.canvas.energy))
        return changed

    def _ended(self, history: int, max_moves: int | None) -> bool:
        return self.vain >= history or self._spent(max_moves)

    def _spent(self, max_moves: int | None) -> bool:
        return max_moves is not None and len(self.moves) >= max_moves

    def _worst(self, allowed: Bool[Tensor, "h w"]) -> tuple[int, int] | None:
        """A pixel of the highest MatchErr."""
        error = torch.where(allowed, self.canvas.error, 0)
        worst = error.max()
        if not float(worst) > 0:
            return None
        places = (error >= worst).nonzero()
        drawn = int(torch.randint(len(places), (), generator=self.generator))
        return int(places[drawn, 0]), int(places[drawn, 1])

    def _tell(self, full: bool) -> None:
        if self.on_step is None:
            return
        canvas = self.canvas
        canvas.refresh()
        row, col = divmod(int(canvas.error.argmax()), canvas.size[1])
        share = float(canvas.known.double().mean())
        done = 0.2 * share if not full else 1 - 0.8 / (1 + self.tried / 250)
        detail = f"E' {canvas.energy:.6g}, {len(self.moves)} moves, worst at {row},{col}"
        self.on_step(Stage(done, "improving" if full else "filling", canvas.image, detail))


def _widened(mask: Bool[Tensor, "h w"], N: int) -> Bool[Tensor, "h w"]:
    """Pixels with a True one in their window."""
    return F.max_pool2d(mask.float()[None], 2 * N + 1, stride=1, padding=N)[0] > 0


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
