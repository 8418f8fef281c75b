"""Image Analogies: every pixel copied from the place whose surroundings are most alike.

Coarse to fine and, at each scale, in scan order. The surroundings of a pixel are the windows of
Q and C around it, what O holds already (the half above and left), and the windows of both at the
next coarser scale. An approximate search over all of the source competes with the places where
the copies of the neighbours go on; d_coh and d_app are squared distances of these surroundings:

    the coherent place is taken if  d_coh <= d_app (1 + 2^(l - L) kappa),  l = L the finest scale

A pixel needs only those above and left of it. So all with column + (reach + 1) * row equal are
independent of each other, and are done at once; the result is that of one pixel after another.

Source: Hertzmann, Jacobs, Oliver, Curless and Salesin 2001; coherence after Ashikhmin 2001.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.image import luminance
from torchtex.inputs import check_seed
from torchtex.matching import Clustered, Index, Matcher, principal_axes
from torchtex.quadratic import threads
from torchtex.recipes.analogy import Analogy
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.transfers import luminance_matched
from torchtex.sources import copied, pixel_places

_SAMPLE = 8192  # surroundings that the axes of the search are computed from
_COARSEST = 16  # pixels: a scale at least has, unless the number of scales is given


def image_analogies(
    problem: Analogy,
    *,
    kappa: float = 2.0,
    levels: int | None = None,
    window: int = 5,
    coarse: int = 3,
    axes: int = 32,
    lightness: bool = False,
    remap: bool = False,
    matcher: Matcher | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """The output O that is to C as the source is to its mapped image, pixel by pixel.

    Args:
        kappa: how much worse a place may be if it goes on where a neighbour's copy ends; 0.5 to
            2 for filters, 5 to 25 for textures.
        levels: scales, each half the next; None for at most 5, the coarsest of 16 pixels or more.
        window, coarse: sides of the windows at a scale and at the next coarser one; odd.
        axes: principal directions that the approximate search is done in.
        lightness: compare lightness alone, as the paper does for filters, instead of colours.
        remap: compare the source and its mapped image as if their lightness had the mean and
            deviation of the constraint's; the pixels that are copied stay as they are.
        matcher: the approximate search; None for `Clustered()`.
        on_step: called now and then; may raise to cancel.

    Raises:
        ValueError: an option out of range.

    Source: Hertzmann et al. 2001, section 3.

    Example:
        >>> s, q, c = torch.rand(3, 20, 20), torch.rand(1, 20, 20), torch.rand(1, 18, 24)
        >>> result = image_analogies(Analogy.of(s, q, c))
        >>> bool((result.apply(s) == result.texture).all())
        True
    """
    started = time.perf_counter()
    count = _levels(problem, levels)
    _check(kappa, window, coarse, axes, seed)
    matcher = Clustered() if matcher is None else matcher
    pyramid = [_scale(problem, lightness, remap)]
    while len(pyramid) < count:
        pyramid.append(pyramid[-1].halved())
    generator = torch.Generator().manual_seed(seed)
    work = [scale.target.shape[1] * scale.target.shape[2] for scale in pyramid]
    found: Tensor | None = None
    with threads(1):  # the pieces are small
        for depth in reversed(range(count)):
            report = _reporter(on_step, problem, pyramid, depth, work)
            above = pyramid[depth + 1] if depth + 1 < count else None
            keys = _Surroundings.of(pyramid[depth], above, found, window, coarse)
            search = _Search.of(keys, matcher, axes, generator)
            guess = search.by_guides() if found is None else _finer(found, pyramid, depth)
            found = _scan(keys, search, guess, 1 + kappa * 0.5**depth, report)
    assert found is not None
    settings = {
        "recipe": "image analogies", "kappa": kappa, "levels": count, "window": window,
        "coarse": coarse, "axes": axes, "lightness": lightness, "remap": remap,
        "matcher": repr(matcher), "size": list(problem.size),
    }  # fmt: skip
    field = copied(pyramid[0].layout.positions(found).view(*problem.size, 3), problem.shapes)
    seconds = time.perf_counter() - started
    texture = field.apply(list(problem.sources))
    return Montage(texture, field, copies(field.source_map()), seconds, seed, settings)


def copies(positions: Int[Tensor, "h w 3"]) -> Int[Tensor, "h w"]:
    """A number for every copy: pixels of one source and one shift, wherever they lie.

    Example:
        >>> copies(torch.tensor([[[0, 3, 3], [0, 3, 4], [0, 0, 0]]])).tolist()
        [[1, 1, 0]]
    """
    size = positions.shape[:2]
    shift = positions.clone()
    shift[..., 1:] -= pixel_places(size, positions.device)
    return shift.flatten(0, 1).unique(dim=0, return_inverse=True)[1].view(size)


@dataclass(frozen=True)
class _Layout:
    """Pixels of several images, numbered end to end."""

    shapes: tuple[tuple[int, int], ...]

    def positions(self, numbers: Tensor) -> Tensor:
        """(..., 3): image, row and column."""
        starts, widths = self._table(numbers)
        which = torch.searchsorted(starts, numbers, right=True) - 1
        within = numbers - starts[which]
        return torch.stack([which, within // widths[which], within % widths[which]], -1)

    def numbers(self, positions: Tensor) -> Tensor:
        """Number of the pixel nearest to a position."""
        starts, widths = self._table(positions)
        which = positions[..., 0]
        limits = torch.tensor(self.shapes, device=positions.device)[which] - 1
        place = torch.minimum(positions[..., 1:].clamp(min=0), limits)
        return starts[which] + place[..., 0] * widths[which] + place[..., 1]

    def all(self, device: torch.device) -> Tensor:
        """(m, 3): positions of all pixels."""
        count = sum(h * w for h, w in self.shapes)
        return self.positions(torch.arange(count, device=device))

    def _table(self, like: Tensor) -> tuple[Tensor, Tensor]:
        areas = torch.tensor([h * w for h, w in self.shapes], device=like.device)
        widths = torch.tensor([w for _, w in self.shapes], device=like.device)
        return areas.cumsum(0) - areas, widths


@dataclass(frozen=True)
class _Scale:
    """What is compared, at one scale: sources, their guides, and that of the output."""

    looks: tuple[Tensor, ...]
    guides: tuple[Tensor, ...]
    target: Tensor

    @property
    def layout(self) -> _Layout:
        return _Layout(tuple((x.shape[1], x.shape[2]) for x in self.looks))

    @property
    def canvas(self) -> _Layout:
        return _Layout(((self.target.shape[1], self.target.shape[2]),))

    def halved(self) -> "_Scale":
        return _Scale(
            tuple(_halved(x) for x in self.looks),
            tuple(_halved(x) for x in self.guides),
            _halved(self.target),
        )


@dataclass(frozen=True)
class _Surroundings:
    """Windows around all pixels of the sources and of the output.

    Args:
        keys: (m, d), of the sources; the last `causal.shape[1]` columns are of the half above.
        fixed: (n, f), of the output, all but that half.
        guides: columns of those that are windows of Q and C.
        looks: (m, c) pixels of the sources.
        steps: (k, 2) from a pixel to those of the half; weights: (k, 1) of each.
    """

    scale: _Scale
    keys: Tensor
    fixed: Tensor
    guides: int
    looks: Tensor
    steps: Tensor
    weights: Tensor

    @staticmethod
    def of(
        scale: _Scale, above: _Scale | None, found: Tensor | None, window: int, coarse: int
    ) -> "_Surroundings":
        q, s, c = _rows(scale.guides), _rows(scale.looks), _rows([scale.target])
        layout, canvas = scale.layout, scale.canvas
        steps, weights = _window(window, s)
        keys, fixed = [_around(q, layout, steps, weights)], [_around(c, canvas, steps, weights)]
        if above is not None and found is not None:
            near, fading = _window(coarse, s)
            looks = _rows(above.looks)
            for theirs, ours in ((_rows(above.guides), _rows([above.target])),
                                 (looks, looks[found])):  # fmt: skip
                keys.append(_around(theirs, layout, near, fading, above.layout))
                fixed.append(_around(ours, canvas, near, fading, above.canvas))
        half = len(steps) // 2
        keys.append(_around(s, layout, steps[:half], weights[:half]))
        guides = keys[0].shape[1]
        return _Surroundings(
            scale, torch.cat(keys, 1), torch.cat(fixed, 1), guides, s, steps[:half], weights[:half]
        )


@dataclass(frozen=True)
class _Search:
    """The approximate search for whole surroundings, in few dimensions."""

    of_all: _Surroundings
    matcher: Matcher
    axes: Tensor
    index: Index

    @staticmethod
    def of(
        around: _Surroundings, matcher: Matcher, axes: int, generator: torch.Generator
    ) -> "_Search":
        keys = around.keys
        some = torch.randperm(len(keys), generator=generator)[:_SAMPLE]
        turned = principal_axes(keys[some.to(keys.device)], axes, generator)
        return _Search(around, matcher, turned, matcher.fit(keys @ turned))

    def by_guides(self) -> Tensor:
        """A first guess: the nearest by the windows of Q and C alone."""
        n = self.of_all.guides
        index = self.matcher.fit(self.of_all.keys[:, :n].contiguous())
        return index.search(self.of_all.fixed[:, :n].contiguous(), 1)[1][:, 0]


def _scan(
    around: _Surroundings,
    search: _Search,
    found: Tensor,
    allowance: float,
    report: Callable[[float, Tensor], None],
) -> Tensor:
    """Number of the source's pixel for every pixel of the output."""
    scale, keys, half = around.scale, around.keys, around.keys.shape[1] - around.fixed.shape[1]
    layout, (h, w) = scale.layout, scale.canvas.shapes[0]
    device = keys.device
    places, shapes = layout.all(device), torch.tensor(layout.shapes, device=device)
    rooms, here = shapes[places[:, 0]], scale.canvas.all(device)
    beside = _neighbours(scale.canvas, around.steps)
    reached = here[:, None, 1:] + around.steps
    inside = ((reached >= 0) & (reached < torch.tensor([h, w], device=device))).all(-1)
    ready = around.fixed @ search.axes[:-half]
    found, out = found.clone(), around.looks[found]
    fronts = _fronts(h, w, 1 - int(around.steps[:, 0].min()))
    for number, front in enumerate(fronts):
        causal = (out[beside[front]] * around.weights).flatten(1)
        query = torch.cat([around.fixed[front], causal], 1)
        near = search.index.search(ready[front] + causal @ search.axes[-half:], 1)[1][:, 0]
        theirs = found[beside[front]]
        moved = places[theirs][..., 1:] - around.steps
        fits = ((moved >= 0) & (moved < rooms[theirs])).all(-1) & inside[front]
        shift = around.steps[:, 0] * rooms[theirs][..., 1] + around.steps[:, 1]
        coherent = torch.where(fits, theirs - shift, near[:, None])
        apart = (keys[coherent] - query[:, None]).square().sum(-1)
        best, which = torch.where(fits, apart, torch.inf).min(1)
        own = (keys[near] - query).square().sum(1)
        chosen = coherent.gather(1, which[:, None])[:, 0]
        found[front] = torch.where(best <= own * allowance, chosen, near)
        out[front] = around.looks[found[front]]
        if number % 32 == 0 or number == len(fronts) - 1:
            report((number + 1) / len(fronts), found)
    return found


def _fronts(h: int, w: int, slope: int) -> list[Int[Tensor, "_"]]:
    """Pixels of an h x w image in groups that do not need each other, in order."""
    order = torch.arange(w) + slope * torch.arange(h)[:, None]
    ranks, pixels = order.flatten().sort(stable=True)
    return list(pixels.split(ranks.unique_consecutive(return_counts=True)[1].tolist()))


def _window(side: int, like: Tensor) -> tuple[Int[Tensor, "k 2"], Float[Tensor, "k 1"]]:
    """Steps to the pixels of a window in scan order, and the roots of a Gaussian's weights."""
    line = torch.arange(side, device=like.device) - side // 2
    steps = torch.stack(torch.meshgrid(line, line, indexing="ij"), -1).flatten(0, 1)
    weights = torch.exp(-steps.to(like).square().sum(1) / (2 * (side / 4) ** 2))
    return steps, (weights / weights.sum()).sqrt()[:, None]


def _neighbours(layout: _Layout, steps: Tensor, above: _Layout | None = None) -> Tensor:
    """(m, k): numbers of the pixels around each, at its scale or the next; borders go on."""
    places = layout.all(steps.device)[:, None].repeat(1, len(steps), 1)
    if above is not None:
        places[..., 1:] //= 2
    places[..., 1:] += steps
    return (layout if above is None else above).numbers(places)


def _around(
    rows: Tensor, layout: _Layout, steps: Tensor, weights: Tensor, above: _Layout | None = None
) -> Float[Tensor, "m d"]:
    return (rows[_neighbours(layout, steps, above)] * weights).flatten(1)


def _rows(images: Sequence[Tensor]) -> Float[Tensor, "m c"]:
    """Pixels of images end to end."""
    return torch.cat([x.flatten(1).T for x in images]).contiguous()


def _halved(image: Float[Tensor, "c h w"]) -> Float[Tensor, "c y x"]:
    """Every other pixel of every other row, after a small Gaussian."""
    line = image.new_tensor([1, 4, 6, 4, 1]) / 16
    x = F.pad(image[:, None], (2, 2, 2, 2), mode="replicate")
    return F.conv2d(F.conv2d(x, line.view(1, 1, 5, 1)), line.view(1, 1, 1, 5))[:, 0, ::2, ::2]


def _finer(found: Tensor, pyramid: Sequence[_Scale], depth: int) -> Tensor:
    """The places found at the scale above, on this one."""
    scale, above = pyramid[depth], pyramid[depth + 1]
    here = scale.canvas.all(found.device)
    odd = here[:, 1:] % 2
    here[:, 1:] //= 2
    places = above.layout.positions(found[above.canvas.numbers(here)])
    places[:, 1:] = 2 * places[:, 1:] + odd
    return scale.layout.numbers(places)


def _scale(problem: Analogy, lightness: bool, remap: bool) -> _Scale:
    changed = luminance_matched(problem) if remap else problem
    if lightness:
        changed = Analogy(
            tuple(luminance(s)[None] for s in changed.sources),
            tuple(tuple(luminance(q)[None] for q in images) for images in changed.mapped),
            tuple(luminance(c)[None] for c in changed.constraints),
            changed.weights,
        )
    guides = tuple(changed.guides(j) for j in range(len(changed.sources)))
    return _Scale(changed.sources, guides, changed.guide())


def _levels(problem: Analogy, levels: int | None) -> int:
    least = min(min(problem.size), *(min(shape) for shape in problem.shapes))
    most = 1 + max(0, int(math.log2(max(least, 1))))
    if levels is None:
        return max(1, min(5, 1 + int(math.log2(max(1, least / _COARSEST)))))
    if not 1 <= levels <= most:
        raise ValueError(f"levels={levels} must lie in 1..{most} for images of this size, or None")
    return levels


def _check(kappa: float, window: int, coarse: int, axes: int, seed: int) -> None:
    if not 0 <= kappa < math.inf:
        raise ValueError(f"kappa={kappa} must be at least 0, and finite")
    for name, side, least in (("window", window, 3), ("coarse", coarse, 1)):
        if side < least or side % 2 == 0:
            raise ValueError(f"{name}={side} must be odd, and at least {least}")
    if axes < 1:
        raise ValueError(f"axes={axes} must be at least 1")
    check_seed(seed)


def _reporter(
    on_step: Callable[[Stage], None] | None,
    problem: Analogy,
    pyramid: Sequence[_Scale],
    depth: int,
    work: Sequence[int],
) -> Callable[[float, Tensor], None]:
    layout, (h, w) = pyramid[depth].layout, pyramid[depth].canvas.shapes[0]
    note = f"scale {len(pyramid) - depth} of {len(pyramid)}"

    def report(done: float, found: Tensor) -> None:
        if on_step is None:
            return
        places = layout.positions(found)
        places[:, 1:] *= 2**depth
        whole = _Layout(problem.shapes)
        texture = _rows(problem.sources)[whole.numbers(places)].T.reshape(-1, h, w)
        share = (sum(work[depth + 1 :]) + done * work[depth]) / sum(work)
        on_step(Stage(share, note, texture))

    return report
