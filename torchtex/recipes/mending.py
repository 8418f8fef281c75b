"""Seams mended: pieces of the exemplars laid over the worst of them, where that makes them better.

A place whose seams are bad is looked for in the exemplars, the best matches are laid over it, and a
min-cut, which counts the older seams, decides how much of one stays: the sum over all seams never
rises. So a thing that a frame or a patch has cut in two becomes whole, or makes room for another.

Which of several matches is taken decides what a texture shows most of. Parts that are shown often
already cost more, and a *taste* makes some places of the exemplars cheaper than others.

Source: refinement, Kwatra et al. 2003, Graphcut textures, section 3.2; here for any source field.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.cuts.poisson import Guidance, solve
from torchtex.cuts.seams import cut_patch, present_seams
from torchtex.inputs import check_not_negative
from torchtex.patches import SsdSearch, box_sums, ssd_search, summed_area
from torchtex.quadratic import threads
from torchtex.recipes.carried import itself, whole_places
from torchtex.recipes.mended_canvas import MendedCanvas, edges_of, views_of
from torchtex.recipes.montage import Montage, Stage
from torchtex.sources import copied

_LOOKS = 4  # that a place is looked for in
_TRIED = 3  # matches for one place
_ROOM = 4  # a match may also cover 1 / _ROOM of the window's side around it
_NEAR = 4  # pixels between two of them
_FITS = 0.3  # cost of a seam, per pixel, that a thing may have around it
_TIRED = 0.5  # weight of a place after each visit


@dataclass(frozen=True)
class Mending:
    """How seams are mended.

    Args:
        count: places that are visited; None for as many as suit the size, 0 for none.
        window: side of what is compared around a place; the piece that is laid over it may reach a
            quarter of that farther on every side.
        place: side of a place.
        turns: also pieces turned by quarter turns.
        mirrors: also mirrored pieces; beside their images they make figures that are symmetric.
        spread: how much dearer matches are for every time that their part of the exemplars is
            shown more often than others; 0: it does not matter.

    Raises:
        ValueError: a number out of range.

    Example:
        >>> Mending(count=20).window
        64
    """

    count: int | None = None
    window: int = 64
    place: int = 16
    turns: bool = True
    mirrors: bool = False
    spread: float = 0.3

    def __post_init__(self) -> None:
        if self.count is not None and not 0 <= self.count <= 100_000:
            raise ValueError(f"count={self.count} must lie in 0..100000, or be None")
        if not 4 <= self.place <= self.window:
            raise ValueError(f"place={self.place} must lie in 4..window={self.window}")
        check_not_negative("spread", self.spread)

    def visits(self, pixels: int) -> int:
        """Places that are visited in a texture of so many pixels."""
        return min(600, pixels // 400) if self.count is None else self.count


def mended(
    made: Montage,
    zs: Sequence[Float[Tensor, "c _ _"]],
    mending: Mending,
    *,
    held: Int[Tensor, "h w"] | None = None,
    looks: Sequence[Montage] | None = None,
    taste: Sequence[Float[Tensor, "_ _"]] | None = None,
    periodic: bool = False,
    poisson: bool = False,
    solver: MinCut | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """A montage whose worst seams are mended; its pixels are read from the exemplars.

    Those that a count of 0 leaves as they are still lose their steps of brightness by `poisson`.

    Args:
        zs: the exemplars that its field names.
        held: numbers of things, and -1 elsewhere. Pieces are laid beside them rather than over
            them, until half of the places are visited; then those that fit badly are given up.
        looks: montages of the exemplars that pieces are taken from; None for the exemplars.
        taste: for each exemplar, what matches cost there is multiplied by.
        periodic: the texture tiles, and its seams at the border count too.
        poisson: find pixels anew from their differences, so that steps of brightness at seams
            vanish; `apply` does not do that.
        seed: of which looks a place is compared with.
        on_step: called after each place; raise from it to cancel.

    Returns:
        A montage; its settings hold the cost of all seams before and after, and the number of
        places that were mended.

    Example:
        >>> from torchtex.recipes.graphcut import Random, graphcut
        >>> z = torch.rand(3, 32, 32)
        >>> rough = graphcut(z, (48, 48), placement=Random(), refine=0)
        >>> done = mended(rough, [z], Mending(10, window=24, place=8))
        >>> done.settings["seams"] <= done.settings["seams_before"]
        True
    """
    solver = default_solver() if solver is None else solver
    positions = made.field.positions[0]
    held = torch.full_like(made.patches, -1) if held is None else held.clone()
    with threads(1):
        canvas = MendedCanvas(
            views_of(positions, zs, periodic=periodic),
            positions.clone(),
            made.patches.clone(),
            held,
            periodic,
        )
        shapes = [(z.shape[1], z.shape[2]) for z in zs]
        sources = [itself(zs, n) for n in range(len(zs))] if looks is None else looks
        generator = torch.Generator().manual_seed(seed)
        found = _looks(zs, sources, mending, taste)
        run = _Run(canvas, found, shapes, mending, solver, generator)
        before = float(canvas.seams.double().sum())
        count = mending.visits(made.patches.numel())
        for step in range(count):
            if 2 * step == count - count % 2:
                run.release()
            if not run.visit():
                break
            if on_step is not None:
                on_step(Stage((step + 1) / count, "mending", canvas.views[0].clone()))
        field = copied(whole_places(canvas.positions), shapes)
        texture = _evened(canvas) if poisson else field.apply(list(zs))
    settings = {
        **made.settings, "mended": run.mended, "seams_before": before,
        "seams": float(canvas.seams.double().sum()),
    }  # fmt: skip
    return replace(made, texture=texture, field=field, patches=canvas.patches, settings=settings)


@dataclass(frozen=True)
class _Look:
    """An exemplar as it is, turned or mirrored."""

    views: Float[Tensor, "5 c h w"]
    positions: Tensor
    places: Int[Tensor, "h w"]  # the same as one number
    search: SsdSearch
    taste: Tensor | None


@dataclass(frozen=True)
class _Match:
    """A part of a look over a rectangle: what it covers, and how much less seams cost then."""

    gain: float
    box: tuple[int, int, tuple[int, int]]  # top, left and size of the rectangle
    labels: Bool[Tensor, "h w"]
    mixed: Float[Tensor, "5 c h w"]
    source: Tensor


class _Run:
    """Visits of the worst places."""

    def __init__(
        self, canvas: MendedCanvas, looks: list[_Look], shapes: Sequence[tuple[int, int]],
        mending: Mending, solver: MinCut, generator: torch.Generator,
    ) -> None:  # fmt: skip
        self.shapes, self.generator = shapes, generator
        self.canvas, self.looks, self.mending, self.solver = canvas, looks, mending, solver
        least = [min(look.places.shape[axis] for look in looks) for axis in (0, 1)]
        height, width = (min(mending.window, *n) for n in zip(canvas.size, least, strict=True))
        self.side = height, width
        self.place = min(mending.place, *self.side)
        self.weight = torch.ones_like(canvas.seams)
        self.mended, self.count = 0, int(canvas.patches.max())

    def visit(self) -> bool:
        """Mends the worst place, if something there is better; False where no seam is left."""
        canvas, place = self.canvas, self.place
        heat = canvas.seams * self.weight
        if canvas.periodic:
            heat = pad(heat[None], (0, place - 1) * 2, mode="circular")[0]
        sums = box_sums(summed_area(heat), place, place)
        worst = int(sums.argmax())
        if not float(sums.flatten()[worst]) > 0:
            return False
        at = divmod(worst, sums.shape[1])
        self.weight[canvas.index(*at, (place, place))] *= _TIRED
        top, left = (a + place // 2 - s // 2 for a, s in zip(at, self.side, strict=True))
        if not canvas.periodic:
            top = min(max(top, 0), canvas.size[0] - self.side[0])
            left = min(max(left, 0), canvas.size[1] - self.side[1])
        found = self._best(top, left)
        if found is not None:
            self._take(found)
        return True

    def release(self) -> None:
        """Gives up the things whose seams are worst."""
        held, seams = self.canvas.held, self.canvas.seams
        edge = (held >= 0) & edges_of(held)
        if not bool(edge.any()):
            return
        numbers = held[edge]
        near = max_pool2d(seams[None], 3, 1, 1)[0][edge].double()
        cost = torch.bincount(numbers, near) / torch.bincount(numbers).clamp(min=1)
        given_up = (cost > _FITS).nonzero().flatten()
        self.canvas.held = torch.where(torch.isin(held, given_up), -1, held)
        self.weight.fill_(1.0)

    def _best(self, top: int, left: int) -> _Match | None:
        """The match that lowers the cost of seams most, if one does."""
        canvas = self.canvas
        rows, cols = canvas.index(top, left, self.side)
        inner = canvas.beside(top, left, self.side) | (canvas.held[rows, cols] >= 0)
        if bool(inner.all()):
            return None
        best = None
        for look, row, col in self._spots(canvas.views[0][:, rows, cols]):
            box, part = self._room(look, (top, left), (row, col))
            index = canvas.index(*box)
            first = canvas.beside(*box) | (canvas.held[index] >= 0)
            old, new = canvas.views[..., index[0], index[1]], look.views[..., part[0], part[1]]
            labels = cut_patch(
                old, new, first, torch.zeros_like(first), gradient=True, solver=self.solver
            )
            mixed = torch.where(labels, new, old)
            gain = _total(old) - _total(mixed)
            if gain > (0 if best is None else best.gain):
                best = _Match(gain, box, labels, mixed, look.positions[part])
        return best

    def _room(
        self, look: _Look, at: tuple[int, int], place: tuple[int, int]
    ) -> tuple[tuple[int, int, tuple[int, int]], tuple[slice, slice]]:
        """The rectangle that a match is laid over, and that of the look: more than was compared.

        So a seam that would run straight along the border of what was compared goes around things.
        """
        starts, sides, parts = [], [], []
        for axis in (0, 1):
            extent, shown = self.canvas.size[axis], look.places.shape[axis]
            before, after = at[axis], extent - at[axis] - self.side[axis]
            if self.canvas.periodic:
                before = after = (extent - self.side[axis]) // 2
            room = self.side[axis] // _ROOM
            before = min(room, before, place[axis])
            after = min(room, after, shown - place[axis] - self.side[axis])
            starts.append(at[axis] - before)
            sides.append(before + self.side[axis] + after)
            parts.append(slice(place[axis] - before, place[axis] + self.side[axis] + after))
        return (starts[0], starts[1], (sides[0], sides[1])), (parts[0], parts[1])

    def _spots(self, template: Tensor) -> list[tuple[_Look, int, int]]:
        """The best matches of what a rectangle shows, none near another."""
        shown = self._shown()
        all_costs = []
        order = torch.randperm(len(self.looks), generator=self.generator)[:_LOOKS].tolist()
        looks = [self.looks[n] for n in order]
        for look in looks:
            costs = look.search(template[None])[0]
            if self.mending.spread > 0:
                usage = box_sums(summed_area(shown[look.places]), *self.side)
                costs = costs * (1 + self.mending.spread * usage / (self.side[0] * self.side[1]))
            if look.taste is not None:
                liked = box_sums(summed_area(look.taste), *self.side)
                costs = costs * (liked / (self.side[0] * self.side[1]))
            all_costs.append(costs)
        found: list[tuple[_Look, int, int]] = []
        while len(found) < _TRIED:
            number = min(range(len(all_costs)), key=lambda n: float(all_costs[n].min()))
            costs = all_costs[number]
            row, col = divmod(int(costs.argmin()), costs.shape[1])
            if not bool(costs[row, col].isfinite()):
                break
            found.append((looks[number], row, col))
            near = (slice(max(x - _NEAR, 0), x + _NEAR + 1) for x in (row, col))
            costs[tuple(near)] = torch.inf
        return found

    def _shown(self) -> Float[Tensor, "n"]:
        """How often every pixel of the exemplars is shown, 1 in the mean."""
        places = _places(self.canvas.positions, self.shapes)
        pixels = sum(h * w for h, w in self.shapes)
        count = torch.bincount(places.flatten(), minlength=pixels).double()
        return count * (pixels / places.numel())

    def _take(self, found: _Match) -> None:
        canvas, (top, left, side) = self.canvas, found.box
        index = canvas.index(top, left, side)
        self.mended += 1
        self.count += 1
        canvas.views[..., index[0], index[1]] = found.mixed
        kind = torch.promote_types(canvas.positions.dtype, found.source.dtype)
        canvas.positions, source = canvas.positions.to(kind), found.source.to(kind)
        canvas.positions[index] = torch.where(
            found.labels[..., None], source, canvas.positions[index]
        )
        canvas.patches[index] = torch.where(found.labels, self.count, canvas.patches[index])
        canvas.measure(top - 1, left - 1, (side[0] + 2, side[1] + 2))


def _looks(
    zs: Sequence[Tensor], sources: Sequence[Montage], mending: Mending,
    taste: Sequence[Tensor] | None,
) -> list[_Look]:  # fmt: skip
    shapes = [(z.shape[1], z.shape[2]) for z in zs]
    liked = None if taste is None else torch.cat([one.flatten() for one in taste])
    looks = []
    for source in sources:
        base = source.field.positions[0]
        for turn in range(4 if mending.turns else 1):
            for mirrored in (False, True) if mending.mirrors else (False,):
                positions = base.rot90(turn, (0, 1))
                positions = positions.flip(1) if mirrored else positions
                places = _places(positions, shapes)
                views = views_of(positions, zs)
                own = None if liked is None else liked[places]
                looks.append(_Look(views, positions, places, ssd_search(views[0]), own))
    return looks


def _evened(canvas: MendedCanvas) -> Float[Tensor, "c h w"]:
    """The picture whose differences are those of the pieces, on seams the mean of both sides."""
    here, below, right, above, left = canvas.views
    across = (right - here + (here - left).roll(-1, 2)) / 2
    down = (below - here + (here - above).roll(-1, 1)) / 2
    if not canvas.periodic:
        across, down = across[:, :, :-1], down[:, :-1]
    guidance = Guidance(across, down, canvas.periodic)
    return solve(guidance, here, boundary="free").clamp(0, 1)


def _places(positions: Tensor, shapes: Sequence[tuple[int, int]]) -> Int[Tensor, "h w"]:
    """Numbers of the nearest pixels, over all exemplars."""
    at = positions.round().long()
    size = at.new_tensor(shapes)
    start = torch.cat([size.new_zeros(1), size.prod(1).cumsum(0)[:-1]])
    return start[at[..., 0]] + at[..., 1] * size[at[..., 0], 1] + at[..., 2]


def _total(views: Float[Tensor, "5 c h w"]) -> float:
    return float(sum(costs.double().sum() for costs in present_seams(views, gradient=True)))
