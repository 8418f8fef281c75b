"""Analogies: Q is to S as C is to the output O. The problem, its labelings and their energies.

S is the source, Q the mapped source and C the constraint; whatever copies a pixel of S into O
copies the pixel of Q beside it into O_Q, and O is good if O_Q looks like C and O has no seams.

A label is a copy of S, turned by quarters or mirrored, laid somewhere over O. N_p is the window
of (2 N + 1) x (2 N + 1) pixels around p, as far as it lies in O; |.| is the Euclidean norm of a
colour, in the units of the images, [0, 1]: the values of K and of the tolerance that the paper
gives are of that scale (in 0..255, B would be lost beside A). Per pixel p and pair (p, q):

    A (p, L) = K sum over r in N_p of |O_Q(r) - C(r)|^2                                (3)
    A'(p, l) = K sum over r in N_p of |Q_l(r) - C(r)|^2
    B (p, q) = |S_L(p)(p) - S_L(q)(p)| + |S_L(p)(q) - S_L(q)(q)|                       (4, 5)
    E (L) = sum of A  + sum of B over neighbouring pixels                              (2)
    E'(L) = sum of A' + sum of B over neighbouring pixels                              (6)
    MatchErr(p) = A(p) + sum of B over the pairs within N_p                            (7)

A label may be used where its copy of S lies. Where a window, or the other pixel of a pair, sticks
out of the copy, the border of the copy goes on; so everywhere here, and in the search of `cms`.
With several constraints A and A' are sums over them, each with its weight.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.cuts.seams import present_seams
from torchtex.image import check_image, luminance, resize
from torchtex.patches import box_sums, summed_area
from torchtex.quadratic import rowwise_sum
from torchtex.sources import SourceField, copied, pixel_places


@dataclass(frozen=True)
class Analogy:
    """Sources with their mapped sources, and the constraints that the output shall meet.

    Args:
        sources: (c, h_j, w_j) images, all with as many channels.
        mapped: for each source a tuple of one (c_k, h_j, w_j) image per constraint.
        constraints: (c_k, H, W) images of the size of the output.
        weights: of the constraints; empty for 1 each.

    Raises:
        ValueError: sizes, channels or counts that do not fit, or NaN; in one sentence.

    Source: Ramanarayanan and Bala 2007, section IV; Hertzmann et al. 2001 (Image analogies).

    Example:
        >>> s, q, c = torch.rand(3, 8, 8), torch.rand(1, 8, 8), torch.rand(1, 6, 9)
        >>> Analogy((s, s), ((q,), (q,)), (c,)).size
        (6, 9)
    """

    sources: tuple[Tensor, ...]
    mapped: tuple[tuple[Tensor, ...], ...]
    constraints: tuple[Tensor, ...]
    weights: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.sources or not self.constraints:
            raise ValueError("source or constraint: none given; give at least one of each")
        if self.weights and len(self.weights) != len(self.constraints):
            raise ValueError(
                f"weights: {len(self.weights)} given for {len(self.constraints)} constraints; "
                "give one each"
            )
        for weight in self.weights:
            if not 0 < weight < math.inf:
                raise ValueError(f"weights={weight} must be above 0, and finite")
        if len(self.mapped) != len(self.sources):
            raise ValueError(
                f"mapped: {len(self.mapped)} given for {len(self.sources)} sources; "
                "give one for every source"
            )
        self._check_constraints()
        for source, images in zip(self.sources, self.mapped, strict=True):
            self._check_source(source, images)

    @staticmethod
    def of(
        source: Float[Tensor, "c h w"],
        mapped: Float[Tensor, "k h w"],
        constraint: Float[Tensor, "k y x"],
    ) -> "Analogy":
        """The usual case: one of each.

        Example:
            >>> Analogy.of(torch.rand(3, 8, 8), torch.rand(1, 8, 8), torch.rand(1, 5, 6)).size
            (5, 6)
        """
        return Analogy((source,), ((mapped,),), (constraint,))

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the output."""
        return self.constraints[0].shape[1], self.constraints[0].shape[2]

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of each source."""
        return tuple((s.shape[1], s.shape[2]) for s in self.sources)

    def guide(self) -> Float[Tensor, "k h w"]:
        """All constraints as one image, each times the root of its weight."""
        return self._stacked(self.constraints)

    def guides(self, source: int) -> Float[Tensor, "k hz wz"]:
        """All mapped images of a source as one, on the scale of `guide`."""
        return self._stacked(self.mapped[source])

    def _stacked(self, images: Sequence[Tensor]) -> Tensor:
        weights = self.weights or (1.0,) * len(images)
        return torch.cat([x * math.sqrt(w) for x, w in zip(images, weights, strict=True)])

    def _check_constraints(self) -> None:
        for constraint in self.constraints:
            check_image(constraint, "constraint")
            _same_type(constraint, self.sources[0], "constraint")
            if constraint.shape[1:] != self.constraints[0].shape[1:]:
                raise ValueError(
                    f"constraint: one is {_by(constraint)} and another "
                    f"{_by(self.constraints[0])}; make them the same size"
                )

    def _check_source(self, source: Tensor, images: Sequence[Tensor]) -> None:
        check_image(source, "source")
        _same_type(source, self.sources[0], "source")
        if len(source) != len(self.sources[0]):
            raise ValueError(
                f"source: one has {len(source)} channels and another {len(self.sources[0])}; "
                "convert them to the same"
            )
        if len(images) != len(self.constraints):
            raise ValueError(
                f"mapped: a source has {len(images)} for {len(self.constraints)} constraints; "
                "give one for every constraint"
            )
        for image, constraint in zip(images, self.constraints, strict=True):
            check_image(image, "mapped")
            _same_type(image, source, "mapped")
            if image.shape[1:] != source.shape[1:]:
                raise ValueError(
                    f"mapped is {_by(image)} and its source {_by(source)}; make them the same size"
                )
            if len(image) != len(constraint):
                raise ValueError(
                    f"mapped has {len(image)} channels and its constraint {len(constraint)}; "
                    "make both grey or both coloured"
                )


@dataclass(frozen=True)
class Variant:
    """A source and its mapped images, turned or mirrored; made by `variants`.

    Args:
        image: the source.
        mapped: all its mapped images, on the scale of `Analogy.guide`.
        positions: source, row and column that each pixel was.
        shape: rows and columns of the source as it was.
        upright: neither turned nor mirrored.
    """

    image: Float[Tensor, "c h w"]
    mapped: Float[Tensor, "k h w"]
    positions: Int[Tensor, "h w 3"]
    shape: tuple[int, int]
    upright: bool


def variants(problem: Analogy, *, turns: bool = True, mirrors: bool = False) -> tuple[Variant, ...]:
    """Every source with its mapped images, in all the ways that labels may turn it.

    Args:
        turns: also by 90, 180 and 270 degrees.
        mirrors: also each of them mirrored.

    Example:
        >>> s, q, c = torch.rand(3, 8, 9), torch.rand(1, 8, 9), torch.rand(1, 5, 6)
        >>> [tuple(v.image.shape) for v in variants(Analogy.of(s, q, c))]
        [(3, 8, 9), (3, 9, 8), (3, 8, 9), (3, 9, 8)]
    """
    made = []
    for number, source in enumerate(problem.sources):
        shape, mapped = problem.shapes[number], problem.guides(number)
        lines = [torch.arange(n, device=source.device) for n in (1, *shape)]
        base = torch.stack(torch.meshgrid(*lines, indexing="ij"))[:, 0]
        base[0] = number
        for turn in range(4 if turns else 1):
            for mirrored in (False, True) if mirrors else (False,):
                parts = [x.rot90(turn, (1, 2)) for x in (source, mapped, base)]
                parts = [(x.flip(2) if mirrored else x).contiguous() for x in parts]
                made.append(
                    Variant(parts[0], parts[1], parts[2].permute(1, 2, 0).contiguous(), shape,
                            turn == 0 and not mirrored)
                )  # fmt: skip
    return tuple(made)


@dataclass(frozen=True)
class Labeling:
    """A label for every pixel of the output.

    Args:
        labels: (h, w, 3): number of the variant, and row and column of the output where the
            first pixel of that variant lies; pixel p shows pixel p - offset of the variant.
        variants: that the labels name.

    Raises:
        ValueError: a label names no variant, or a pixel that lies outside it.

    Example:
        >>> problem = Analogy.of(*(torch.rand(1, 4, 4) for _ in range(3)))
        >>> labeling = Labeling(torch.zeros(4, 4, 3).long(), variants(problem))
        >>> bool((render(labeling, problem.sources) == problem.sources[0]).all())
        True
    """

    labels: Int[Tensor, "h w 3"]
    variants: tuple[Variant, ...]

    def __post_init__(self) -> None:
        which = self.labels[..., 0]
        if int(which.min()) < 0 or int(which.max()) >= len(self.variants):
            raise ValueError(
                f"labels name the variants {int(which.min())}..{int(which.max())}; there are "
                f"0..{len(self.variants) - 1}"
            )
        if bool((self.places() != self._places(True)).any()):
            raise ValueError("labels leave their variant; a pixel may have a label that covers it")

    def places(self) -> Int[Tensor, "h w 2"]:
        """Row and column of each pixel in its variant."""
        return self._places(False)

    def _places(self, clamped: bool) -> Tensor:
        h, w = self.labels.shape[:2]
        return _reached(self, 0, 0, slice(0, h), slice(0, w), clamped)


def placed(positions: Int[Tensor, "h w 3"], made: tuple[Variant, ...]) -> Labeling:
    """The labeling of an output whose pixels were copied upright, by any method.

    Args:
        positions: source, row and column of every pixel, such as `Montage.source_map`.
        made: of `variants`.

    Example:
        >>> problem = Analogy.of(*(torch.rand(1, 4, 4) for _ in range(3)))
        >>> placed(torch.zeros(2, 2, 3).long(), variants(problem)).labels[1, 1].tolist()
        [0, 1, 1]
    """
    upright = [i for i, v in enumerate(made) if v.upright]
    which = torch.tensor(upright, device=positions.device)[positions[..., 0]]
    here = pixel_places(positions.shape[:2], positions.device)
    return Labeling(torch.cat([which[..., None], here - positions[..., 1:]], -1), made)


def source_field(labeling: Labeling) -> SourceField:
    """Where every pixel came from, in the sources as they were given.

    Example:
        >>> problem = Analogy.of(*(torch.rand(1, 4, 4) for _ in range(3)))
        >>> whole = Labeling(torch.zeros(4, 4, 3).long(), variants(problem))
        >>> source_field(whole).source_map()[2, 3].tolist()
        [0, 2, 3]
    """
    h, w = labeling.labels.shape[:2]
    stack = _Flat.of([v.positions.permute(2, 0, 1) for v in labeling.variants])
    positions = stack.read(labeling, 0, 0, slice(0, h), slice(0, w)).permute(1, 2, 0)
    shapes = {int(v.positions[0, 0, 0]): v.shape for v in labeling.variants}
    return copied(positions, [shapes[j] for j in sorted(shapes)])


def render(labeling: Labeling, images: Sequence[Float[Tensor, "k _ _"]]) -> Float[Tensor, "k h w"]:
    """The output that a labeling makes of one image for each source, of its size.

    Example:
        >>> problem = Analogy.of(*(torch.rand(1, 4, 4) for _ in range(3)))
        >>> whole = Labeling(torch.zeros(3, 2, 3).long(), variants(problem))
        >>> render(whole, [torch.rand(7, 4, 4)]).shape
        torch.Size([7, 3, 2])
    """
    return source_field(labeling).apply(list(images))


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
        >>> problem = Analogy.of(torch.rand(3, 6, 6), torch.ones(1, 6, 6), torch.zeros(1, 3, 3))
        >>> whole = Labeling(torch.zeros(3, 3, 3).long(), variants(problem))
        >>> agreement(problem, whole, K=2.0, N=1)[0].tolist()
        [8.0, 12.0, 8.0]
    """
    check_window(K, N)
    h, w = labeling.labels.shape[:2]
    stack = _Flat.of([v.mapped for v in labeling.variants])
    shown = stack.read(labeling, 0, 0, slice(0, h), slice(0, w))
    apart = (shown - problem.guide()).square().sum(0)
    return K * window_sums(apart, N)


def label_agreement(
    problem: Analogy, labeling: Labeling, *, K: float, N: int
) -> Float[Tensor, "h w"]:
    """A' at every pixel: the copy of Q that its label lays there against the constraint.

    Example:
        >>> problem = Analogy.of(torch.rand(3, 6, 6), torch.ones(1, 6, 6), torch.zeros(1, 3, 3))
        >>> whole = Labeling(torch.zeros(3, 3, 3).long(), variants(problem))
        >>> label_agreement(problem, whole, K=2.0, N=1)[0].tolist()
        [8.0, 12.0, 8.0]
    """
    check_window(K, N)
    (h, w), guide = labeling.labels.shape[:2], problem.guide()
    stack = _Flat.of([v.mapped for v in labeling.variants])
    total = guide.new_zeros(h, w)
    for down in range(-min(N, h - 1), min(N, h - 1) + 1):
        for across in range(-min(N, w - 1), min(N, w - 1) + 1):
            # pixels whose neighbour there lies in the output
            rows = slice(max(0, -down), h - max(0, down))
            cols = slice(max(0, -across), w - max(0, across))
            there = guide[:, rows.start + down : rows.stop + down,
                          cols.start + across : cols.stop + across]  # fmt: skip
            shown = stack.read(labeling, down, across, rows, cols)
            total[rows, cols] += (shown - there).square().sum(0)
    return K * total


def boundary(labeling: Labeling) -> tuple[Float[Tensor, "h w_"], Float[Tensor, "h_ w"]]:
    """B of every pair (equations 4 and 5): a pixel and the one to its right; and that below.

    Example:
        >>> problem = Analogy.of(*3 * [torch.rand(1, 6, 6)])
        >>> right, down = boundary(Labeling(torch.zeros(6, 6, 3).long(), variants(problem)))
        >>> right.shape, down.shape, right.max().item()
        (torch.Size([6, 5]), torch.Size([5, 6]), 0.0)
    """
    return present_seams(views(labeling))


def views(labeling: Labeling) -> Float[Tensor, "5 c h w"]:
    """What the label of each pixel shows there and below, right, above and left of it.

    Example:
        >>> problem = Analogy.of(*3 * [torch.rand(1, 6, 6)])
        >>> views(Labeling(torch.zeros(6, 6, 3).long(), variants(problem))).shape
        torch.Size([5, 1, 6, 6])
    """
    h, w = labeling.labels.shape[:2]
    stack = _Flat.of([v.image for v in labeling.variants])
    steps = ((0, 0), (1, 0), (0, 1), (-1, 0), (0, -1))
    whole = slice(0, h), slice(0, w)
    return torch.stack([stack.read(labeling, i, j, *whole) for i, j in steps])


def match_error(problem: Analogy, labeling: Labeling, *, K: float, N: int) -> Tensor:
    """MatchErr at every pixel (equation 7): where the labeling is worst.

    Example:
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


def match_luminance(
    image: Float[Tensor, "c h w"], like: Float[Tensor, "k y x"], by: Tensor | None = None
) -> Float[Tensor, "c h w"]:
    """An image whose lightness has the mean and the deviation of another's; hues are kept.

    Y <- (Y - mean(Y)) dev(Y_like) / dev(Y) + mean(Y_like), the same step in every channel

    Args:
        by: the image whose lightness is measured instead of the image's own. With `by=mapped`
            source and mapped go through one map, as in Image Analogies.

    Source: Hertzmann et al. 2001, section 3.4.

    Example:
        >>> grey = match_luminance(torch.rand(1, 9, 9), torch.full((1, 4, 4), 0.25))
        >>> round(grey.mean().item(), 4)
        0.25
    """
    own, of, other = luminance(image), luminance(image if by is None else by), luminance(like)
    deviation = of.std(correction=0)
    gain = torch.where(deviation > 0, other.std(correction=0) / deviation.clamp(min=1e-12), 1)
    return (image + ((own - of.mean()) * gain + other.mean() - own)).clamp(0, 1)


def luminance_matched(problem: Analogy) -> Analogy:
    """The problem, its sources and first mapped images as light as the first constraint.

    Source: Hertzmann et al. 2001, section 3.4.

    Example:
        >>> s, q, c = torch.rand(3, 8, 9), torch.rand(1, 8, 9), torch.full((1, 5, 6), 0.25)
        >>> round(luminance_matched(Analogy.of(s, q, c)).mapped[0][0].mean().item(), 4)
        0.25
    """
    like = problem.constraints[0]
    pairs = list(zip(problem.sources, problem.mapped, strict=True))
    return replace(
        problem,
        sources=tuple(match_luminance(s, like, by=q[0]) for s, q in pairs),
        mapped=tuple((match_luminance(q[0], like), *q[1:]) for _, q in pairs),
    )


def detail_problem(
    sample: Float[Tensor, "c h w"], low: Float[Tensor, "k y x"], factor: int | float
) -> Analogy:
    """Detail for a small picture: S is the sample, Q the sample as coarse as the small picture.

    Args:
        sample: sharp picture of the same kind of thing, at the scale of the output.
        low: the picture to enlarge.
        factor: of enlargement, per side; above 1, up to 10 or so.

    Raises:
        ValueError: as `Analogy`, or another factor.

    Example:
        >>> detail_problem(torch.rand(3, 20, 20), torch.rand(3, 6, 4), 4).size
        (24, 16)
    """
    check_image(sample, "sample")
    check_image(low, "low")
    if not 1 < factor < math.inf:
        raise ValueError(f"factor={factor} must be above 1, and finite")
    h, w = sample.shape[1:]
    if min(h, w) < factor:
        raise ValueError(
            f"sample is {_by(sample)}, less than factor={factor}; give a larger sample"
        )
    small = shrunk(sample, (round(h / factor), round(w / factor)))
    size = round(low.shape[1] * factor), round(low.shape[2] * factor)
    mapped, constraint = resize(small, (h, w)).clamp(0, 1), resize(low, size).clamp(0, 1)
    return Analogy.of(sample, mapped, constraint)


def shrunk(image: Float[Tensor, "c h w"], size: tuple[int, int]) -> Float[Tensor, "c y x"]:
    """A picture reduced by averages over boxes, as a camera of fewer pixels sees it.

    Example:
        >>> shrunk(torch.ones(3, 8, 8), (2, 3)).shape
        torch.Size([3, 2, 3])
    """
    return F.interpolate(image[None], size=size, mode="area")[0]


def detail_error(
    output: Float[Tensor, "c h w"], low: Float[Tensor, "c y x"], factor: int | float
) -> float:
    """Root mean square of the output, reduced, minus the small picture; 0.01 is 1 % of white.

    Raises:
        ValueError: the output is not the small picture enlarged by the factor.

    Example:
        >>> detail_error(torch.full((1, 8, 8), 0.5), torch.full((1, 2, 2), 0.25), 4)
        0.25
    """
    wanted = round(low.shape[1] * factor), round(low.shape[2] * factor)
    if tuple(output.shape[1:]) != wanted:
        raise ValueError(
            f"output is {_by(output)}; factor={factor} makes {wanted[0]}x{wanted[1]} of low"
        )
    small = shrunk(output, (low.shape[1], low.shape[2]))
    return float((small - low).square().mean().sqrt())


def back_projected(
    output: Float[Tensor, "c h w"], low: Float[Tensor, "c y x"], factor: int | float
) -> Float[Tensor, "c h w"]:
    """The output, its coarse colours corrected so that reduced it is the small picture.

    A copy of a sample has only the colours of the sample; the correction is smooth, so that the
    detail stays. Afterwards the pixels are no longer copies.

    Source: Irani and Peleg 1991 (iterative back projection).

    Example:
        >>> x, low = torch.rand(1, 16, 16), torch.full((1, 4, 4), 0.5)
        >>> detail_error(back_projected(x, low, 4), low, 4) < 0.01 < detail_error(x, low, 4)
        True
    """
    detail_error(output, low, factor)  # refuses sizes that do not fit
    for _ in range(5):
        lack = low - shrunk(output, (low.shape[1], low.shape[2]))
        output = (output + resize(lack, (output.shape[1], output.shape[2]))).clamp(0, 1)
    return output


def sharpness_ratio(output: Float[Tensor, "c h w"], source: Float[Tensor, "c hz wz"]) -> float:
    """Mean gradient of the output's lightness over that of the source's; below 1 is blurred.

    Example:
        >>> x = torch.rand(3, 9, 9)
        >>> round(sharpness_ratio(x / 2, x), 4)
        0.5
    """
    return _gradient(output) / max(_gradient(source), 1e-12)


def transfer_problem(
    source: Float[Tensor, "c h w"],
    target: Float[Tensor, "k y x"],
    *,
    blur: float = 0.0,
    match: bool = False,
    contrast: float = 1.0,
) -> Analogy:
    """Texture transfer: the target shown in a texture, by lightness.

    Args:
        blur: deviation, in pixels, of a Gaussian that both lightnesses are blurred by.
        match: give the target's lightness the mean and deviation of the source's first, since
            a texture cannot show what is lighter or darker than itself.
        contrast: times the deviation of the target's lightness, in the end. A portrait with
            `match` was clearest at 1.8: the source's rare tones are then used too.

    Raises:
        ValueError: as `Analogy`, or `blur` is negative, or `contrast` not positive.

    Source: Efros and Freeman 2001, section 3; Ramanarayanan and Bala 2007, section V-E.

    Example:
        >>> transfer_problem(torch.rand(3, 20, 20), torch.rand(3, 9, 8), blur=1.0).size
        (9, 8)
    """
    check_image(source, "source")
    check_image(target, "target")
    if not 0 <= blur < math.inf:
        raise ValueError(f"blur={blur} must be at least 0, and finite")
    if not 0 < contrast < math.inf:
        raise ValueError(f"contrast={contrast} must be above 0, and finite")
    mapped, constraint = luminance(source)[None], luminance(target)[None]
    if blur > 0:
        mapped, constraint = _blurred(mapped, blur), _blurred(constraint, blur)
    constraint = match_luminance(constraint, mapped) if match else constraint
    if contrast != 1:
        mean = constraint.mean()
        constraint = ((constraint - mean) * contrast + mean).clamp(0, 1)
    return Analogy.of(source, mapped, constraint)


@dataclass(frozen=True)
class Snapped:
    """Label maps whose colours are those of one palette; made by `snapped`.

    Args:
        mapped, constraint: the maps.
        palette: (m, c) colours of the mapped source.
        changed: pixels of mapped and of constraint that had another colour.
    """

    mapped: Float[Tensor, "c h w"]
    constraint: Float[Tensor, "c y x"]
    palette: Float[Tensor, "m c"]
    changed: tuple[int, int]


def snapped(
    mapped: Float[Tensor, "c h w"],
    constraint: Float[Tensor, "k y x"],
    *,
    near: float = 0.1,
    share: float = 0.002,
) -> Snapped:
    """Texture-by-numbers maps with clean colours, whose edges and shades were not quite even.

    The palette holds the colours that many pixels of the mapped source have. A pixel near one of
    them gets it; one between, as on a smooth edge, gets the nearest of those around it.

    Args:
        near: distance, per channel, of colours that count as one.
        share: of the pixels that a colour must have, with those near it, to be one of a palette.

    Raises:
        ValueError: channels differ, there is no palette, or colours of the constraint are none of
            the mapped source's; the sentence lists them.

    Example:
        >>> maps = torch.tensor([0.0, 0.0, 0.1, 1.0, 1.0, 0.9])[None, None].expand(1, 6, 6)
        >>> clean = snapped(maps, 1 - maps, near=0.2)
        >>> clean.palette.flatten().tolist(), clean.changed
        ([0.0, 1.0], (12, 12))
    """
    check_image(mapped, "mapped")
    check_image(constraint, "constraint")
    if len(mapped) != len(constraint):
        raise ValueError(
            f"mapped has {len(mapped)} channels and constraint {len(constraint)}; "
            "make both grey or both coloured"
        )
    if not 0 < near < 1 or not 0 < share < 1:
        raise ValueError(f"near={near} and share={share} must lie between 0 and 1")
    palette = _palette(mapped, near, share)
    if not len(palette):
        raise ValueError(
            "mapped has no colour that many pixels share, so it is no map of regions; "
            "paint each region in one colour"
        )
    used = _palette(constraint, near, share)
    strange = used[(torch.cdist(used, palette, p=torch.inf) > 2 * near).all(1)]
    if len(strange):
        raise ValueError(
            f"constraint has colours that mapped has not: {_listed(strange)}; "
            f"paint it in those of mapped: {_listed(palette)}"
        )
    maps = [_snap(x, palette, near) for x in (mapped, constraint)]
    changed = [int(((a - b).abs().amax(0) > 0.5 / 255).sum())
               for a, b in zip(maps, (mapped, constraint), strict=True)]  # fmt: skip
    return Snapped(maps[0], maps[1], palette, (changed[0], changed[1]))


def _palette(image: Tensor, near: float, share: float) -> Tensor:
    """(m, c): colours of many pixels, the most frequent first of those near each other."""
    colours, counts = (image.flatten(1).T * 255).round().unique(dim=0, return_counts=True)
    order = counts.argsort(descending=True, stable=True)[:4096]
    colours, counts = colours[order] / 255, counts[order]
    kept: list[Tensor] = []
    free = torch.ones(len(colours), dtype=torch.bool, device=image.device)
    for i in range(len(colours)):
        if not bool(free[i]):
            continue
        alike = free & ((colours - colours[i]).abs().amax(1) <= near)
        free &= ~alike
        total = int(counts[alike].sum())
        # colours of soft edges are many and each rare
        if total >= share * image[0].numel() and int(counts[i]) * 4 >= total:
            kept.append(colours[i])
    return torch.stack(kept) if kept else colours[:0]


def _snap(image: Tensor, palette: Tensor, near: float) -> Tensor:
    distances = torch.stack([(image - p[:, None, None]).abs().amax(0) for p in palette])
    sure = (distances <= near).to(image)
    around = F.max_pool2d(sure[None], 5, stride=1, padding=2)[0] > 0
    local = torch.where(around, distances, torch.inf).argmin(0)
    best = torch.where(sure.amax(0) > 0, distances.argmin(0), local)
    best = torch.where(around.any(0), best, distances.argmin(0))
    return palette.T[:, best]


def _listed(colours: Tensor) -> str:
    return ", ".join(
        "(" + ", ".join(str(round(255 * v)) for v in c) + ")" for c in colours.tolist()
    )


def _blurred(image: Tensor, sigma: float) -> Tensor:
    reach = max(1, math.ceil(3 * sigma))
    line = torch.arange(-reach, reach + 1, dtype=image.dtype, device=image.device)
    kernel = torch.exp(-0.5 * (line / sigma).square())
    kernel = (kernel / kernel.sum())[None, None]
    x = F.pad(image[:, None], (reach, reach, reach, reach), mode="replicate")
    return F.conv2d(F.conv2d(x, kernel[:, :, None]), kernel[..., None])[:, 0]


def _gradient(image: Tensor) -> float:
    y = luminance(image).double()
    across, down = y[:-1, 1:] - y[:-1, :-1], y[1:, :-1] - y[:-1, :-1]
    return float((across.square() + down.square()).sqrt().mean())


@dataclass(frozen=True)
class _Flat:
    """Images of all variants, end to end, to be read by label."""

    values: Tensor
    starts: Tensor
    widths: Tensor

    @staticmethod
    def of(images: Sequence[Tensor]) -> "_Flat":
        device = images[0].device
        sizes = torch.tensor([x[0].numel() for x in images], device=device)
        widths = torch.tensor([x.shape[2] for x in images], device=device)
        values = torch.cat([x.flatten(1) for x in images], 1)
        return _Flat(values, sizes.cumsum(0) - sizes, widths)

    def read(self, labeling: Labeling, down: int, across: int, rows: slice, cols: slice) -> Tensor:
        """What the labels of a part of the output show at a pixel further down and across."""
        which = labeling.labels[rows, cols, 0]
        places = _reached(labeling, down, across, rows, cols, True)
        return self.values[:, self.starts[which] + places[..., 0] * self.widths[which]
                           + places[..., 1]]  # fmt: skip


def _reached(
    labeling: Labeling, down: int, across: int, rows: slice, cols: slice, clamped: bool
) -> Tensor:
    labels = labeling.labels[rows, cols]
    device = labels.device
    corner = labels.new_tensor([rows.start + down, cols.start + across])
    places = pixel_places(labels.shape[:2], device) + corner - labels[..., 1:]
    if not clamped:
        return places
    limits = torch.tensor([v.image.shape[1:] for v in labeling.variants], device=device) - 1
    return torch.minimum(places.clamp(min=0), limits[labels[..., 0]])


def _same_type(image: Tensor, like: Tensor, name: str) -> None:
    if image.dtype != like.dtype or image.device != like.device:
        raise ValueError(
            f"{name} is {image.dtype} on {image.device} beside {like.dtype} on {like.device}; "
            "convert them to the same"
        )


def _by(image: Tensor) -> str:
    return f"{image.shape[1]}x{image.shape[2]}"
