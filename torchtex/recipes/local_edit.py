"""Local edits with a rough brush: paint over an object, and it appears whole somewhere else.

Each stroke is a two-label problem on the pixels around the place where it goes: 1 shows the
reference, moved (turned, scaled), and 0 the base as it is.

    E(L) = sum over pixels of  v [L_p = 0 under the stroke]
         + sum over neighbours of  S(p, q) [L_p != L_q]

    S(p, q) = k1 (|C(p)| + |C(q)|) + k2 (|G(p)| + |G(q)|)

C is the difference of both pictures, G that of their gradients: two components per channel.
That is the paper's energy. What it leaves open is which pixels are free, and among alike things
lying close together it cuts through them wherever two of one colour meet. `Objects` has our
answer to both; `objects=None` is the paper's formula, on four neighbours.

Source: Shen et al. 2010, section 3.2, equations 2 and 3; Agarwala et al. 2004 for the stroke as
a constraint; Perez et al. 2003 for the paste.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.cuts.poisson import Guidance, solve
from torchtex.inputs import check_pair
from torchtex.quadratic import threads
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.strokes import Placed, Stroke, distance, place
from torchtex.sources import copied, pixel_places

_NEAR = [(0, 1), (1, 0)]
_FAR = [*_NEAR, (1, 1), (1, -1)]
_SAMPLES = 256  # colours that stand for the object, and for what is around it
_ROWS = 16384  # pixels compared with them at a time


@dataclass(frozen=True)
class Objects:
    """What keeps objects whole, in addition to the paper's smoothness.

        S'(p, q) = (S(p, q) + length mean(S)) (1 + whole f) / (1 + outline (1 - f) g^2) / |p - q|

    on eight neighbours, so that a slanted seam costs what its length is. f, in [0, 1], tells how
    much both pixels look like the stroke's colours in the reference rather than those around it;
    it fades away from the stroke. g is the contrast of the blurred reference between the pixels,
    1 on average. So a seam keeps out of what looks like the object, and elsewhere follows
    outlines of the reference, even if the base happens to agree inside of them.

    Args:
        whole: how much dearer a seam within the object's colours is.
        outline: how much cheaper a seam is along an outline of the reference.
        length: cost of a seam where both pictures agree, against detours.
        doubt: share of the mark's half width that is uncertain at its rim, for marks that spill
            over; 0 believes all of it.
        level: difference of colour up to which the paste evens out both sides of the seam; more
            is taken for an edge of the object, and bleeds nowhere.

    Raises:
        ValueError: a number out of range.

    Example:
        >>> Objects(outline=0.0).whole
        4.0
    """

    whole: float = 4.0
    outline: float = 3.0
    length: float = 1.0
    doubt: float = 0.25
    level: float = 0.25

    def __post_init__(self) -> None:
        for name in ("whole", "outline", "length"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 0, and finite")
        if not 0 <= self.doubt < 1:
            raise ValueError(f"doubt={self.doubt} must be at least 0 and below 1")
        if not 0 < self.level < math.inf:
            raise ValueError(f"level={self.level} must be above 0, and finite")


def edit(
    base: Float[Tensor, "c h w"],
    strokes: Sequence[Stroke],
    *,
    reference: Float[Tensor, "_ hz wz"] | None = None,
    reference_mask: Bool[Tensor, "hz wz"] | None = None,
    data_cost: float = 1e6,
    k1: float = 0.5,
    k2: float = 0.5,
    band: int | None = None,
    objects: Objects | None = Objects(),
    poisson: bool = True,
    solver: MinCut | None = None,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """Puts what the strokes mark in the reference into the base, one stroke after the other.

    Under the mark a pixel must show the reference (leaving it to the base costs `data_cost`),
    but for a rim that `objects` may leave open. In light paint, and within `band` pixels of the
    mark, the cut decides. Farther away, and wherever the moved reference has no pixel, the base
    stays.

    Args:
        reference: None for the base itself, as it is before the first stroke.
        reference_mask: True where the reference may be used.
        data_cost: v of equation 2, per pixel.
        k1, k2: weights of colours and of gradients in equation 3.
        band: width of the uncertain band in pixels; None for 1.5 times the radius of a disk of
            the mark's area, so that a mark over the middle of an object reaches all of it.
        objects: what keeps them whole; None for the paper's energy and plain Poisson cloning.
        poisson: even out colours at the seam; False copies pixels.
        solver: None for the first one that is installed.
        on_step: called after every stroke; may raise to cancel.

    Returns:
        The montage: exemplar 0 is the base, 1 the reference if one is given, and patch i shows
        stroke i, counted from 1; 0 is the base.

    Raises:
        ValueError: pictures or masks that do not fit, no strokes, an option out of range, or a
            stroke that ends outside the base.
        ImportError: no min-cut is installed.

    Source: Shen et al. 2010, section 3.2.

    Example:
        >>> from torchtex.recipes.strokes import brush
        >>> image, mark = torch.rand(3, 40, 40), brush((40, 40), [(12.0, 12.0)], 4.0)
        >>> done = edit(image, [Stroke(mark, (14, 12))], poisson=False)
        >>> torch.equal(done.texture[:, 26, 24], image[:, 12, 12]), int(done.patches.max())
        (True, 1)
    """
    started = time.perf_counter()
    source = base if reference is None else reference
    _check(base, source, reference_mask, strokes)
    _check_numbers(data_cost, k1, k2, band)
    cut = _Cut(data_cost, k1, k2, objects, default_solver() if solver is None else solver)
    canvas = _canvas(base, source, reference is not None)
    usable = torch.ones_like(source[0]) if reference_mask is None else reference_mask.to(source)
    with threads(1):  # the pieces are small
        for number, stroke in enumerate(strokes, 1):
            placed = place(base.shape[1:], source, usable, stroke, band, number)
            old = canvas.texture[:, placed.window[0], placed.window[1]]
            labels, alike = cut(old, placed)
            pixels = placed.image
            if poisson:
                level = None if objects is None else objects.level
                pixels = _evened(old, pixels, labels, alike, level)
            canvas.paste(placed, labels, pixels, number)
            if on_step is not None:
                detail = f"{number} of {len(strokes)}"
                on_step(Stage(number / len(strokes), "strokes", canvas.texture, detail))
    settings = {
        "recipe": "edit",
        "strokes": len(strokes),
        "data_cost": data_cost,
        "k1": k1,
        "k2": k2,
        "band": band,
        "objects": None if objects is None else asdict(objects),
        "poisson": poisson,
    }
    field = copied(canvas.positions, canvas.shapes)
    seconds = time.perf_counter() - started
    return Montage(canvas.texture, field, canvas.patches, seconds, 0, settings)


def _check(base: Tensor, source: Tensor, usable: Tensor | None, strokes: Sequence[Stroke]) -> None:
    check_pair(base, source, "reference")
    if not len(strokes):
        raise ValueError("strokes is empty; give at least one")
    size = tuple(source.shape[1:])
    if usable is not None and tuple(usable.shape) != size:
        raise ValueError(
            f"reference_mask has shape {tuple(usable.shape)} and the reference {size}; "
            "make them the same size"
        )
    for number, stroke in enumerate(strokes, 1):
        if tuple(stroke.mask.shape) != size:
            raise ValueError(
                f"stroke {number}: mask has shape {tuple(stroke.mask.shape)} and the reference "
                f"{size}; paint on a mask of the size of the reference"
            )


def _check_numbers(data_cost: float, k1: float, k2: float, band: int | None) -> None:
    if not 0 < data_cost < math.inf:
        raise ValueError(f"data_cost={data_cost} must be above 0, and finite")
    for name, value in (("k1", k1), ("k2", k2)):
        if not 0 <= value < math.inf:
            raise ValueError(f"{name}={value} must be at least 0, and finite")
    if k1 + k2 == 0:
        raise ValueError("k1=0 and k2=0 leave seams without a cost; raise one of them")
    if band is not None and band < 1:
        raise ValueError(f"band={band} must be at least 1 pixel")


@dataclass(frozen=True)
class _Cut:
    """The labels of a stroke."""

    data_cost: float
    k1: float
    k2: float
    objects: Objects | None
    solver: MinCut

    def __call__(self, old: Tensor, new: Placed) -> tuple[Tensor, Tensor]:
        """True where the reference goes; and how much of the object each pixel looks like."""
        core = new.marked
        apart = self.k1 * _norm(old - new.image)
        apart = apart + self.k2 * _norm(_slopes(old) - _slopes(new.image))
        alike = torch.zeros_like(apart)
        steps = _NEAR if self.objects is None else _FAR
        if self.objects is None:
            costs = [_both(apart, step) for step in steps]
        else:
            alike = _likeness(new)
            costs = self._object_costs(self.objects, apart, alike, new)
            core = _without_rim(core, self.objects.doubt)
        unary = torch.stack([self.data_cost * core.to(apart), torch.zeros_like(apart)], -1)
        unary[..., 1].masked_fill_(~new.free, torch.inf)
        node = torch.arange(apart.numel(), device=apart.device).view(apart.shape)
        edges = torch.cat([torch.stack(_pair(node, step), -1).flatten(0, 1) for step in steps])
        capacity = torch.cat([cost.flatten() for cost in costs])[:, None].expand(-1, 2)
        labels = self.solver(unary.flatten(0, 1), edges, capacity).view(apart.shape)
        return labels, alike

    def _object_costs(
        self, objects: Objects, apart: Tensor, alike: Tensor, new: Placed
    ) -> list[Tensor]:
        soft = _blurred(new.image, 0.7)  # grain is no outline
        edges = [(a - b).square().sum(0) for a, b in (_pair(soft, step) for step in _FAR)]
        within = [torch.minimum(*_pair(new.free, step)) for step in _FAR]
        usual = torch.cat([e[i] for e, i in zip(edges[:2], within[:2], strict=True)]).mean()
        floor = objects.length * 2 * apart[new.free].mean()
        costs = []
        for step, edge in zip(_FAR, edges, strict=True):
            square = step[0] ** 2 + step[1] ** 2
            both = torch.minimum(*_pair(alike, step))
            cost = (_both(apart, step) + floor) * (1 + objects.whole * both)
            contrast = edge / square / usual.clamp_min(1e-12)
            cost = cost / (1 + objects.outline * (1 - both) * contrast)
            costs.append(cost / math.sqrt(square))
        return costs


def _without_rim(core: Tensor, doubt: float) -> Tensor:
    depth = distance(~core, math.ceil(math.sqrt(float(core.sum()) / math.pi)) + 1)
    if not (~core).any():
        return core
    return core & (depth > doubt * depth[core].max())


def _likeness(new: Placed) -> Tensor:
    """(h, w) in [0, 1]: do colours speak for the mark, or for what lies beyond the band?"""
    if not new.around.any():
        return torch.zeros_like(new.image[0])
    soft = _blurred(new.image, 0.7)
    pixels = soft.flatten(1).T
    spread = (pixels - pixels.mean(0)).square().sum(1).mean()
    width = 0.2 * spread.sqrt().clamp_min(1e-6)
    here, there = (_density(pixels, soft[:, which].T, width) for which in (new.marked, new.around))
    ratio = (here / (here + there + 1e-3)).view(new.marked.shape)
    return ratio * torch.exp(-0.5 * new.beyond.square()).to(ratio)


def _density(pixels: Tensor, colors: Tensor, width: Tensor) -> Tensor:
    """(n,): mean of a Gaussian around each colour; of evenly chosen ones if there are many."""
    chosen = torch.linspace(0, len(colors) - 1, min(len(colors), _SAMPLES), device=pixels.device)
    colors = colors[chosen.round().long()] / width
    parts = [
        torch.exp(-0.5 * torch.cdist(part / width, colors).square()).mean(1)
        for part in pixels.split(_ROWS)
    ]
    return torch.cat(parts)


@dataclass
class _Canvas:
    """The base with the strokes so far."""

    texture: Tensor
    positions: Tensor
    patches: Tensor
    shapes: tuple[tuple[int, int], ...]

    def paste(self, new: Placed, labels: Tensor, pixels: Tensor, number: int) -> None:
        if new.positions.is_floating_point():
            self.positions = self.positions.float()
        exemplar = self.positions.new_tensor([len(self.shapes) - 1, 0, 0])
        self.positions[new.window][labels] = new.positions.to(self.positions)[labels] + exemplar
        self.patches[new.window][labels] = number
        self.texture = self.texture.clone()  # previews that were handed out stay as they are
        part = self.texture[:, new.window[0], new.window[1]]
        part.copy_(torch.where(labels, pixels, part))


def _evened(old: Tensor, new: Tensor, labels: Tensor, alike: Tensor, level: float | None) -> Tensor:
    """The new pixels with the smoothest change that meets the old ones around the labels."""
    apart = old - new
    if level is not None:  # an edge of the object is there to stay
        apart = apart * (1 - alike) * torch.exp(-apart.square().sum(0) / level**2)
    still = Guidance(torch.zeros_like(apart[:, :, 1:]), torch.zeros_like(apart[:, 1:]))
    return (new + solve(still, apart, labels, boundary="free")).clamp(0, 1)


def _canvas(base: Tensor, source: Tensor, two: bool) -> _Canvas:
    h, w = base.shape[1:]
    positions = F.pad(pixel_places((h, w), base.device), (1, 0))  # of exemplar 0
    shapes = [(h, w)] + ([(source.shape[1], source.shape[2])] if two else [])
    patches = torch.zeros(h, w, dtype=torch.long, device=base.device)
    return _Canvas(base.clone(), positions, patches, tuple(shapes))


def _norm(x: Tensor) -> Tensor:
    return x.square().sum(0).sqrt()


def _slopes(x: Tensor) -> Tensor:
    """(2c, h, w): central differences across and down."""
    wide = F.pad(x[None], (1, 1, 1, 1), mode="replicate")[0]
    across = wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]
    return torch.cat([across, wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]]) / 2


def _pair(x: Tensor, step: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Values at both ends of every pair of pixels that is so many rows and columns apart."""
    down, right = step
    h, w = x.shape[-2:]
    if right < 0:
        return x[..., : h - down, -right:], x[..., down:, : w + right]
    return x[..., : h - down, : w - right], x[..., down:, right:]


def _both(x: Tensor, step: tuple[int, int]) -> Tensor:
    start, end = _pair(x, step)
    return start + end


def _blurred(image: Tensor, sigma: float) -> Tensor:
    from kornia.filters import gaussian_blur2d

    width = 2 * math.ceil(2 * sigma) + 1
    border = "replicate"
    return gaussian_blur2d(image[None], (width, width), (sigma, sigma), border_type=border)[0]
