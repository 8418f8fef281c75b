"""Other ways to an analogy, to measure `cms` by: quilting, random placement, and texture energy.

All copy pixels of the source, or weigh them, and so have a source for every pixel; `labeling_of`
makes of it a labeling, whose energies can be compared.
"""

import math
import time
from collections.abc import Callable

import torch
from jaxtyping import Int
from torch import Tensor

from torchtex.controls import Guide
from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.inputs import check_seed
from torchtex.quadratic import threads
from torchtex.recipes.analogy import Analogy
from torchtex.recipes.analogy_costs import check_window, energy
from torchtex.recipes.cms import CmsMove, CmsResult, patch_numbers
from torchtex.recipes.cms_canvas import Canvas
from torchtex.recipes.correspondence import Correspondence
from torchtex.recipes.labelings import Labeling, placed, source_field, variants
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.quilting import transfer
from torchtex.result import Progress, Result, at_full_size
from torchtex.synthesize import synthesize

_GLANCE = 10  # moves between looks at the clock, and reports
_SHRINK = 1.5  # a block of `transfer` over that of its next pass


def constrained_quilting(
    problem: Analogy,
    *,
    block: int | None = None,
    final: int = 7,
    tolerance: float = 0.1,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """Image quilting of ever smaller blocks that agree with the constraint, down to small ones.

    It is `quilting.transfer` with the mapped images, of all constraints stacked, as the
    correspondence: the first pass lays large blocks, each later one blocks a third smaller that
    also agree with what the pass before made.

    Args:
        block: side of the blocks of the first pass, about; None for 64, or as many pixels as a
            quarter of the shortest side.
        final: side of those of the last pass. The smaller it is, the closer to the constraint,
            and the slower: every block is searched in the whole source.
        tolerance: how much dearer than the best a drawn block may be.

    Raises:
        ValueError: an option out of range, or a block that fits nowhere.

    Source: Efros and Freeman 2001, section 3, as read by Ramanarayanan and Bala 2007, IV-D.

    Example:
        >>> s, q, c = torch.rand(3, 24, 24), torch.rand(1, 24, 24), torch.rand(1, 20, 30)
        >>> result = constrained_quilting(Analogy.of(s, q, c), block=10, final=5)
        >>> bool((result.apply(s) == result.texture).all())
        True
    """
    shortest = min(min(shape) for shape in problem.shapes)
    if not 3 <= final <= shortest:
        raise ValueError(f"final={final} must lie in 3..{shortest}, the sources' shortest side")
    first = max(final, min(64, shortest // 4)) if block is None else block
    if not final <= first <= shortest:
        raise ValueError(
            f"block={first} must lie in final={final}..{shortest}, the sources' shortest side"
        )
    passes = 1 + math.ceil(math.log(first / final) / math.log(_SHRINK))
    begin = min(round(final * _SHRINK ** (passes - 1)), shortest)
    guides = tuple(problem.guides(j) for j in range(len(problem.sources)))
    return transfer(
        list(problem.sources),
        problem.guide(),
        correspondence=Correspondence(guides, problem.guide()),
        block=begin,
        iterations=passes,
        tolerance=tolerance,
        seed=seed,
        on_step=on_step,
    )


def random_placement(
    problem: Analogy,
    *,
    K: float = 1.0,
    N: int = 3,
    moves: int | None = None,
    seconds: float | None = None,
    turns: bool = True,
    mirrors: bool = False,
    solver: MinCut | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> CmsResult:
    """Expansion moves of labels drawn at random, lowering the same E' as `cms`.

    Args:
        K, N, turns, mirrors, solver: as in `cms`.
        moves: that are tried, once every pixel has a label; None for no limit.
        seconds: of the processor that all may take; None for no limit. The result then depends
            on the machine.

    Raises:
        ValueError: an option that makes no sense, or neither limit.
        ImportError: no min-cut solver is installed.

    Source: Schoedl 2002 (thesis), as told by Ramanarayanan and Bala 2007, IV-D.

    Example:
        >>> z = torch.rand(3, 16, 16)
        >>> random_placement(Analogy.of(z, z, z), N=2, moves=20).tried >= 20
        True
    """
    started, begun = time.perf_counter(), time.process_time()
    check_window(K, N)
    _check_limits(moves, seconds, seed)
    solver = default_solver() if solver is None else solver
    generator = torch.Generator().manual_seed(seed)
    kept: list[CmsMove] = []
    tried = improving = 0
    with threads(1):
        canvas = Canvas(problem, variants(problem, turns=turns, mirrors=mirrors), K, N, solver)
        full, passed = False, 0.0
        while not full or _goes_on(improving, moves, passed, seconds):
            label = _drawn(canvas.size, [v.image.shape[1:] for v in canvas.variants], generator)
            changed = len(canvas.expand(label))
            tried += 1
            improving += full
            if changed:
                place = max(label[1], 0), max(label[2], 0)
                kept.append(CmsMove(place, label, changed, canvas.energy))
                full = full or canvas.full
            if tried % _GLANCE == 1:  # to ask for the time may cost as much as a move
                passed = time.process_time() - begun
            if on_step is not None and tried % _GLANCE == 1:
                spent = _spent(improving, moves, passed, seconds)
                note = "improving" if full else "filling"
                detail = f"E' {canvas.energy:.6g}, {len(kept)} of {tried} moves"
                on_step(Stage(min(spent, 1.0), note, canvas.image, detail))
        labeling = Labeling(canvas.labels, canvas.variants)
        energies = energy(problem, labeling, K=K, N=N)
    settings = {
        "recipe": "random placement", "K": K, "N": N, "moves": moves, "limit": seconds,
        "turns": turns, "mirrors": mirrors, "weights": list(problem.weights),
        "size": list(problem.size), "sources": [list(s) for s in problem.shapes],
    }  # fmt: skip
    field = source_field(labeling)
    montage = Montage(
        field.apply(list(problem.sources)), field, patch_numbers(labeling.labels, kept),
        time.perf_counter() - started, seed, settings,
    )  # fmt: skip
    return CmsResult(montage, labeling, energies, tuple(kept), 0, tried)


def guided(
    problem: Analogy,
    *,
    weight: float = 2.0,
    r: float = 0.8,
    seed: int = 0,
    on_step: Callable[[Progress], None] | None = None,
) -> Result:
    """Our own `synthesize`, with the constraints as guides.

    Args:
        weight: of the squared distance of guides, against 1 for that of pixels.
        r: robust exponent; 2 is least squares.

    Raises:
        ValueError: an option out of range, or a source too small for any window.

    Source: Kwatra et al. 2005, with the guides of Hertzmann et al. 2001.

    Example:
        >>> s, q, c = torch.rand(3, 32, 32), torch.rand(1, 32, 32), torch.rand(1, 32, 40)
        >>> guided(Analogy.of(s, q, c)).texture.shape
        torch.Size([3, 32, 40])
    """
    guides = [problem.guides(j) for j in range(len(problem.sources))]

    return synthesize(
        list(problem.sources),
        problem.size,
        r=r,
        guides=[Guide(guides, problem.guide(), weight)],
        seed=seed,
        on_step=at_full_size(on_step, problem.size),
    )


def labeling_of(problem: Analogy, positions: Int[Tensor, "h w 3"]) -> Labeling:
    """The labeling of any method that copies upright, by `source_map` of what it returns.

    Of `guided`, whose pixels are weighed means of copies, it is the copy that weighs most.

    Example:
        >>> problem = Analogy.of(*(torch.rand(1, 4, 4) for _ in range(3)))
        >>> labeling_of(problem, torch.zeros(4, 4, 3).long()).places()[2, 2].tolist()
        [0, 0]
    """
    return placed(positions, variants(problem, turns=False))


def _drawn(
    size: tuple[int, int], shapes: list[torch.Size], generator: torch.Generator
) -> tuple[int, int, int]:
    """A variant, and where it lies such that it covers some of the output; all alike."""
    number = int(torch.randint(len(shapes), (), generator=generator))
    row, col = (
        int(torch.randint(1 - extent, room, (), generator=generator))
        for extent, room in zip(shapes[number], size, strict=True)
    )
    return number, row, col


def _goes_on(tried: int, moves: int | None, spent: float, seconds: float | None) -> bool:
    return (moves is None or tried < moves) and (seconds is None or spent < seconds)


def _spent(tried: int, moves: int | None, spent: float, seconds: float | None) -> float:
    """Share of the limits that is used up."""
    return max(
        0.0 if moves is None else tried / max(moves, 1),
        0.0 if seconds is None else spent / seconds,
    )


def _check_limits(moves: int | None, seconds: float | None, seed: int) -> None:
    if moves is None and seconds is None:
        raise ValueError("moves or seconds: none given; give a limit, or it would never end")
    if moves is not None and moves < 0:
        raise ValueError(f"moves={moves} must be at least 0, or None for no limit")
    if seconds is not None and not 0 < seconds < math.inf:
        raise ValueError(f"seconds={seconds} must be above 0, or None for no limit")
    check_seed(seed)
