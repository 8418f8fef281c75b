"""Textures that tile: a texture made into a tube, twice, by the best seam, and cut open again.

Along each axis the last `overlap` pixels are laid over the first ones and a seam is cut between
the two, so the ends join as a tube, shorter by the overlap. The tube is opened along a line where
the neighbours were neighbours in the texture: the border of the tile is whole, and the seam lies
inside. The second seam closes around the tube that the first one made.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut
from torchtex.cuts.paths import dp_mask
from torchtex.cuts.poisson import Guidance, solve
from torchtex.cuts.seams import cut_seam, patch_views, seam_costs
from torchtex.image import check_image
from torchtex.recipes.montage import Montage, Stage
from torchtex.sources import copied

_BATCH = 2**23  # path sums kept at a time
_STRETCH = 16  # pixels of border that are judged together, as in `metrics.battery`


@dataclass(frozen=True)
class BestOverlap:
    """Tries all overlaps in a range, and keeps the least that has almost the cheapest seam.

    A pattern with a period, such as a wall of bricks, joins at overlaps that leave whole periods.

    Args:
        least, most: shares of the texture's side.
        slack: how much dearer than the cheapest a seam may be, per pixel, so that the tile stays
            large: 0.1 for a tenth.

    Raises:
        ValueError: a range that is empty or goes beyond half the side.

    Example:
        >>> BestOverlap(most=0.25).range(64)
        (8, 16)
    """

    least: float = 0.125
    most: float = 0.4
    slack: float = 0.1

    def __post_init__(self) -> None:
        if not 0 < self.least <= self.most <= 0.5:
            raise ValueError(
                f"least={self.least}, most={self.most} must be shares of the side, in that order "
                "and at most 0.5"
            )
        if not 0 <= self.slack < float("inf"):
            raise ValueError(f"slack={self.slack} must be at least 0, and finite")

    def range(self, side: int) -> tuple[int, int]:
        """The least and the most overlap of a side, in pixels."""
        most = max(2, int(self.most * side))
        return min(max(2, round(self.least * side)), most), most


def cyclic(
    texture: Float[Tensor, "c h w"],
    *,
    overlap: tuple[int, int] | BestOverlap = BestOverlap(),
    cut: Literal["mincut", "dp"] = "mincut",
    solver: MinCut | None = None,
    opening: Literal["best", "half"] = "best",
    poisson: bool = False,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """The texture with opposite sides that continue each other.

    Args:
        overlap: rows and columns that the tile loses; those of the paper are fixed.
        cut: "mincut", or "dp" for a path that has one pixel in each row.
        solver: of "mincut"; None for the first one that is installed.
        opening: where the tubes are opened: "half", in the middle of the texture as in the paper,
            or "best", where the border is least visible. The tiled plane is the same.
        poisson: make the pixels anew from gradients, which spreads what is left of a step at a
            seam. `apply` still copies.

    Returns:
        A texture of (h - rows, w - columns) pixels, copied from the given one.

    Raises:
        ValueError: a texture of fewer than 4 pixels a side, or an overlap of fewer than 2 pixels
            or more than half of it.

    Source: Shen et al. 2006, Completion-based texture design, section 3.5; the search for the
        overlap and for the line of opening are ours.

    Example:
        >>> tile = cyclic(torch.rand(3, 24, 32), overlap=(6, 8))
        >>> tile.texture.shape
        torch.Size([3, 18, 24])
    """
    begin = time.perf_counter()
    check_image(texture, "texture")
    for name, value, allowed in (
        ("cut", cut, ("mincut", "dp")),
        ("opening", opening, ("best", "half")),
    ):
        if value not in allowed:
            raise ValueError(f"{name}={value!r} is unknown; choose {' or '.join(allowed)}")
    given = _checked(overlap, (texture.shape[1], texture.shape[2]))
    seams = _Seams(cut, solver)
    rows, columns = (
        torch.arange(n, device=texture.device) for n in (texture.shape[1], texture.shape[2])
    )
    places = torch.stack(torch.meshgrid(rows, columns, indexing="ij"), -1)
    # across first, and then down, around the tube
    places, across = _tube(texture, places, given[1], False, seams)
    _tell(on_step, 0.4, "cut across", texture, places)
    places, down = _tube(texture, places.transpose(0, 1), given[0], True, seams)
    places = places.transpose(0, 1)
    _tell(on_step, 0.8, "cut down", texture, places)
    places, patches = _opened(texture, places, (down, across), opening)
    field = copied(
        torch.cat([torch.zeros_like(places[..., :1]), places], -1),
        ((texture.shape[1], texture.shape[2]),),
    )
    whole = field.apply(texture)
    if poisson:
        whole = _fused(texture, places, whole)
    settings = {
        "recipe": "cyclic",
        "overlap": [down, across],
        "sought": asdict(overlap) if isinstance(overlap, BestOverlap) else None,
        "cut": cut,
        "opening": opening,
        "poisson": poisson,
    }
    _tell(on_step, 1.0, "open", texture, places)
    return Montage(whole, field, patches, time.perf_counter() - begin, 0, settings)


class Visibility(NamedTuple):
    """Steps across the seams of a tile relative to those inside; 1 cannot be seen.

    Args:
        mean: of all pairs of pixels that a seam parts, over the mean of all that none parts.
        worst: the same of the worst window of 16 x 16 pixels with at least 8 such pairs in it,
            over the 99th percentile of all windows' means of unparted pairs.
    """

    mean: float
    worst: float


def seam_visibility(tile: Montage, *, window: int = _STRETCH) -> Visibility:
    """How visible the seams inside a tile of `cyclic` are, around its border too.

    The border of a tile says nothing of its seams, which lie elsewhere: this follows them.

    Example:
        >>> seam_visibility(cyclic(torch.rand(3, 40, 40), overlap=(10, 10))).mean < 2
        True
    """
    x, places = tile.texture, tile.field.positions[0, ..., 1:]
    parted, step = [], []
    for axis in (0, 1):
        unit = torch.tensor([1 - axis, axis], device=places.device)
        parted.append(((places.roll(-1, axis) - places) != unit).any(-1))
        step.append((x.roll(-1, axis + 1) - x).abs().mean(0))
    cut, size = torch.stack(parted).to(x), torch.stack(step)
    if not bool(cut.any()):
        return Visibility(1.0, 1.0)
    tiny = 1e-8
    mean = (
        (size * cut).sum()
        / cut.sum()
        / ((size * (1 - cut)).sum() / (1 - cut).sum().clamp(min=1) + tiny)
    )
    at = _boxes(cut, window)
    seam = torch.where(at >= window // 2, _boxes(size * cut, window) / at.clamp(min=1), 0)
    rest = _boxes(size * (1 - cut), window) / _boxes(1 - cut, window).clamp(min=1)
    return Visibility(float(mean), float(seam.max() / (rest.flatten().quantile(0.99) + tiny)))


def _boxes(x: Tensor, window: int) -> Tensor:
    """Sums over both axes' pairs in all windows of a torus."""
    h, w = x.shape[1:]
    for axis, n in ((1, h), (2, w)):
        wide = torch.cat([x, x.narrow(axis, 0, min(window, n) - 1)], axis)
        x = wide.unfold(axis, min(window, n), 1).sum(-1)
    return x.sum(0)


class _Seams(NamedTuple):
    cut: str
    solver: MinCut | None

    def __call__(self, end: Tensor, start: Tensor, closed: bool) -> Tensor:
        """True where the texture begins anew: `end` runs in from the left, `start` leaves right."""
        if self.cut == "dp":
            return dp_mask((end - start).square().sum(0), 0, closed=closed)
        # squared: a few pixels of a bad step are seen sooner than many of a fair one. Costs that
        # look for edges, divided by gradients, left steps half as large again on thirty photos.
        right, down = (cost.square() for cost in seam_costs(end, start, wrap=(closed, False)))
        first = torch.zeros_like(end[0], dtype=torch.bool)
        first[:, 0] = True
        return cut_seam(right, down, first, first.flip(1), solver=self.solver)


def _checked(
    overlap: tuple[int, int] | BestOverlap, size: tuple[int, int]
) -> tuple[int | BestOverlap, int | BestOverlap]:
    if min(size) < 4:
        raise ValueError(f"texture of {size[0]}x{size[1]} is too small; give at least 4x4 pixels")
    if isinstance(overlap, BestOverlap):
        return overlap, overlap
    for pixels, side, name in zip(overlap, size, ("rows", "columns"), strict=True):
        if not 2 <= pixels <= side // 2:
            raise ValueError(
                f"overlap={overlap[0]}x{overlap[1]}: of the {side} {name} of the texture between "
                f"2 and {side // 2} may overlap"
            )
    return overlap


def _tube(
    texture: Tensor, places: Tensor, overlap: int | BestOverlap, closed: bool, seams: _Seams
) -> tuple[Tensor, int]:
    """Places whose last column leads back to the first, and the overlap that was lost."""
    picture = texture[:, places[..., 0], places[..., 1]]
    if isinstance(overlap, BestOverlap):
        overlap = _sought(picture, overlap)
    period = places.shape[1] - overlap
    begins = seams(picture[..., period:], picture[..., :overlap], closed)
    joined = torch.where(begins[..., None], places[:, :overlap], places[:, period:])
    return torch.cat([joined, places[:, overlap:period]], 1), overlap


def _sought(picture: Tensor, search: BestOverlap) -> int:
    """The least overlap whose cheapest path costs hardly more, per pixel, than any other's."""
    h, w = picture.shape[1:]
    least, most = search.range(w)
    costs = []
    count = max(1, _BATCH // (h * most))
    for overlaps in torch.arange(least, most + 1).split(count):
        errors = picture.new_full((len(overlaps), h, most), torch.inf)
        for error, overlap in zip(errors, overlaps.tolist(), strict=True):
            apart = picture[..., w - overlap :] - picture[..., :overlap]
            error[:, :overlap] = apart.square().sum(0).square()  # above all no bad pixels
        costs.append(_cheapest(errors))
    cost = torch.cat(costs)
    return least + int((cost <= cost.min() * (1 + search.slack)).nonzero()[0])


def _cheapest(errors: Float[Tensor, "n h w"]) -> Float[Tensor, "n"]:
    """Sum along the cheapest path from top to bottom, for many pictures."""
    sums = errors[:, 0]
    for row in errors[:, 1:].unbind(1):
        wide = torch.nn.functional.pad(sums, (1, 1), value=torch.inf)
        sums = row + torch.minimum(torch.minimum(wide[:, :-2], wide[:, 2:]), sums)
    return sums.amin(1)


def _opened(
    texture: Tensor, places: Tensor, overlap: tuple[int, int], opening: str
) -> tuple[Int[Tensor, "h w 2"], Int[Tensor, "h w"]]:
    """The tubes cut open, and the piece that each pixel belongs to."""
    picture = texture[:, places[..., 0], places[..., 1]]
    patches = torch.zeros_like(places[..., 0])
    starts = []
    for axis, lost in enumerate(overlap):
        n = places.shape[axis]
        if opening == "half":
            start = (n + lost) // 2
        else:
            # lines whose neighbours were neighbours: any from the overlap on
            step = (picture - picture.roll(1, axis + 1)).abs().mean(0)
            step = step if axis == 0 else step.T
            around = torch.cat([step, step[:, : _STRETCH - 1]], 1)
            worst = around.unfold(1, min(_STRETCH, around.shape[1]), 1).mean(2).amax(1)
            worst = worst / worst.mean() + step.mean(1) / step.mean()
            start = lost + int(worst[lost:].argmin()) if lost < n else lost
        starts.append(start)
        # beyond the seam the texture has begun anew, so it lies before the opening
        patches = 2 * patches + (places[..., axis] < start)
    turn = (-starts[0], -starts[1])
    return places.roll(turn, (0, 1)), patches.roll(turn, (0, 1))


def _fused(texture: Tensor, places: Tensor, whole: Tensor) -> Tensor:
    """Pixels whose steps are those of the texture, and across a seam the mean of both sides'."""
    here, below, right, above, left = patch_views(texture)[:, :, places[..., 0], places[..., 1]]
    guidance = Guidance(
        ((right - here) + (here - left).roll(-1, 2)) / 2,
        ((below - here) + (here - above).roll(-1, 1)) / 2,
        periodic=True,
    )
    return solve(guidance, whole).clamp(0, 1)


def _tell(
    on_step: Callable[[Stage], None] | None, done: float, note: str, texture: Tensor, at: Tensor
) -> None:
    if on_step is not None:
        on_step(Stage(done, note, texture[:, at[..., 0], at[..., 1]]))
