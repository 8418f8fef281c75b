"""What a labeling of an analogy costs: agreement with the constraint, and seams.

N_p is the window of (2 N + 1) x (2 N + 1) pixels around p, as far as it lies in O; |.| is the
Euclidean norm of a colour, in the units of the images, [0, 1]: the values of K and of the
tolerance that the paper gives are of that scale (in 0..255, B would be lost beside A). Per pixel
p and pair (p, q):

    A (p, L) = K sum over r in N_p of |O_Q(r) - C(r)|^2                                (3)
    A'(p, l) = K sum over r in N_p of |Q_l(r) - C(r)|^2
    B (p, q) = |S_L(p)(p) - S_L(q)(p)| + |S_L(p)(q) - S_L(q)(q)|                       (4, 5)
    E (L) = sum of A  + sum of B over neighbouring pixels                              (2)
    E'(L) = sum of A' + sum of B over neighbouring pixels                              (6)
    MatchErr(p) = A(p) + sum of B over the pairs within N_p                            (7)

With several constraints A and A' are sums over them, each with its weight.

Source: Ramanarayanan and Bala 2007, section IV-B.
"""

import math
from dataclasses import dataclass

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.cuts.seams import present_seams
from torchtex.patches import box_sums, summed_area
from torchtex.quadratic import rowwise_sum
from torchtex.recipes.analogy import Analogy
from torchtex.recipes.labelings import Flat, Labeling, views


@dataclass(frozen=True)
class Energies:
    """What a labeling costs.

    Args:
        agreement: sum of A over all pixels, of the output as it is.
        label_agreement: sum of A', of each label by itself.
        boundary: sum of B over all pairs of neighbours.
    """

    agreement: float
    label_agreement: float
    boundary: float

    @property
    def exact(self) -> float:
        """E, equation 2."""
        return self.agreement + self.boundary

    @property
    def minimised(self) -> float:
        """E', equation 6, which expansion moves lower."""
        return self.label_agreement + self.boundary


def energy(problem: Analogy, labeling: Labeling, *, K: float, N: int) -> Energies:
    """E, E' and their parts, for the labeling of any method.

    Raises:
        ValueError: K or N that make no sense.

    Source: Ramanarayanan and Bala 2007, equations 2 and 6.

    Example:
        >>> from torchtex.recipes.labelings import variants
        >>> problem = Analogy.of(*3 * [torch.rand(1, 6, 6)])
        >>> whole = Labeling(torch.zeros(6, 6, 3).long(), variants(problem))
        >>> energy(problem, whole, K=1.0, N=2)
        Energies(agreement=0.0, label_agreement=0.0, boundary=0.0)
    """
    sums = [
        float(rowwise_sum(x.double().flatten()))
        for x in (
            agreement(problem, labeling, K=K, N=N),
            label_agreement(problem, labeling, K=K, N=N),
            *boundary(labeling),
        )
    ]
    return Energies(sums[0], sums[1], sums[2] + sums[3])


def agreement(problem: Analogy, labeling: Labeling, *, K: float, N: int) -> Float[Tensor, "h w"]:
    """A at every pixel (equation 3): the output against the constraint.

    Example:
        >>> from torchtex.recipes.labelings import variants
        >>> problem = Analogy.of(torch.rand(3, 6, 6), torch.ones(1, 6, 6), torch.zeros(1, 3, 3))
        >>> whole = Labeling(torch.zeros(3, 3, 3).long(), variants(problem))
        >>> agreement(problem, whole, K=2.0, N=1)[0].tolist()
        [8.0, 12.0, 8.0]
    """
    check_window(K, N)
    h, w = labeling.labels.shape[:2]
    flat = Flat.of([v.mapped for v in labeling.variants])
    shown = flat.read(labeling, 0, 0, slice(0, h), slice(0, w))
    apart = (shown - problem.guide()).square().sum(0)
    return K * window_sums(apart, N)


def label_agreement(
    problem: Analogy, labeling: Labeling, *, K: float, N: int
) -> Float[Tensor, "h w"]:
    """A' at every pixel: the copy of Q that its label lays there against the constraint.

    Example:
        >>> from torchtex.recipes.labelings import variants
        >>> problem = Analogy.of(torch.rand(3, 6, 6), torch.ones(1, 6, 6), torch.zeros(1, 3, 3))
        >>> whole = Labeling(torch.zeros(3, 3, 3).long(), variants(problem))
        >>> label_agreement(problem, whole, K=2.0, N=1)[0].tolist()
        [8.0, 12.0, 8.0]
    """
    check_window(K, N)
    (h, w), guide = labeling.labels.shape[:2], problem.guide()
    flat = Flat.of([v.mapped for v in labeling.variants])
    total = guide.new_zeros(h, w)
    for down in range(-min(N, h - 1), min(N, h - 1) + 1):
        for across in range(-min(N, w - 1), min(N, w - 1) + 1):
            # pixels whose neighbour there lies in the output
            rows = slice(max(0, -down), h - max(0, down))
            cols = slice(max(0, -across), w - max(0, across))
            there = guide[:, rows.start + down : rows.stop + down,
                          cols.start + across : cols.stop + across]  # fmt: skip
            shown = flat.read(labeling, down, across, rows, cols)
            total[rows, cols] += (shown - there).square().sum(0)
    return K * total


def boundary(labeling: Labeling) -> tuple[Float[Tensor, "h w_"], Float[Tensor, "h_ w"]]:
    """B of every pair (equations 4 and 5): a pixel and the one to its right; and that below.

    Example:
        >>> from torchtex.recipes.labelings import variants
        >>> problem = Analogy.of(*3 * [torch.rand(1, 6, 6)])
        >>> right, down = boundary(Labeling(torch.zeros(6, 6, 3).long(), variants(problem)))
        >>> right.shape, down.shape, right.max().item()
        (torch.Size([6, 5]), torch.Size([5, 6]), 0.0)
    """
    return present_seams(views(labeling))


def match_error(problem: Analogy, labeling: Labeling, *, K: float, N: int) -> Tensor:
    """MatchErr at every pixel (equation 7): where the labeling is worst.

    Example:
        >>> from torchtex.recipes.labelings import variants
        >>> problem = Analogy.of(*3 * [torch.rand(1, 6, 6)])
        >>> whole = Labeling(torch.zeros(6, 6, 3).long(), variants(problem))
        >>> match_error(problem, whole, K=1.0, N=2).max().item()
        0.0
    """
    right, down = boundary(labeling)
    return agreement(problem, labeling, K=K, N=N) + pair_sums(right, down, N)


def window_sums(x: Float[Tensor, "h w"], N: int) -> Float[Tensor, "h w"]:
    """Sum over N_p at every pixel p.

    Example:
        >>> window_sums(torch.ones(3, 3), 1)[0].tolist()
        [4.0, 6.0, 4.0]
    """
    side = 2 * N + 1
    return box_sums(summed_area(F.pad(x, (N, N, N, N))), side, side).clamp(min=0).to(x.dtype)


def pair_sums(
    right: Float[Tensor, "h w_"], down: Float[Tensor, "h_ w"], N: int
) -> Float[Tensor, "h w"]:
    """Sum of a cost of pairs over those within N_p, at every pixel p.

    Example:
        >>> pair_sums(torch.ones(3, 2), torch.ones(2, 3), 1).tolist()
        [[4.0, 7.0, 4.0], [7.0, 12.0, 7.0], [4.0, 7.0, 4.0]]
    """
    side = 2 * N + 1
    tables = [summed_area(F.pad(x, (N, N, N, N))) for x in (right, down)]
    total = box_sums(tables[0], side, side - 1) + box_sums(tables[1], side - 1, side)
    return total.clamp(min=0).to(right.dtype)


def check_window(K: float, N: int) -> None:
    """Refuses a weight or a window that makes no sense.

    Example:
        >>> check_window(K=2.0, N=5)
    """
    if not 0 <= K < math.inf:
        raise ValueError(f"K={K} must be at least 0, and finite")
    if N < 1:
        raise ValueError(f"N={N} must be at least 1; the window has 2 N + 1 pixels a side")
