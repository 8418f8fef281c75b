"""Parts of Wang tiles: patches for the colours of edges, and a tile cut from four of them.

The edges of a tile are counted clockwise from the north. A patch lies with the middle of its
rows or columns on its edge; half of it, and a little more, is in the tile.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut
from torchtex.cuts.paths import dp_seam
from torchtex.cuts.seams import cut_patch, patch_views
from torchtex.recipes.montage import Stage

NORTH, EAST, SOUTH, WEST = range(4)


@dataclass(frozen=True)
class Choice:
    """How the patches of the colours are chosen: the best of many, one at a time, in turn.

    Args:
        candidates: random places tried for a patch while the others stay.
        rounds: times that every patch is chosen.
        tries: times that all this is begun anew.

    Raises:
        ValueError: a number below 1.

    Example:
        >>> Choice(tries=1).candidates
        200
    """

    candidates: int = 200
    rounds: int = 3
    tries: int = 4

    def __post_init__(self) -> None:
        for name in ("candidates", "rounds", "tries"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")


def extents(side: int, reach: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Height and width of the patch of a horizontal edge, and of a vertical one.

    Example:
        >>> extents(16, 10)
        ((20, 16), (16, 20))
    """
    return (2 * reach, side), (side, 2 * reach)


def _along(edge: int, side: int, reach: int) -> tuple[int, int]:
    """Row and column of a patch that lie on the first pixel of a tile with the patch on an edge."""
    return ((reach, 0), (0, reach - side), (reach - side, 0), (0, reach))[edge]


def shift(edge: int, places: Tensor, color: int, side: int, reach: int) -> tuple[int, int]:
    """What to add to a pixel of a tile for the pixel of the exemplar in the patch of an edge.

    Example:
        >>> shift(NORTH, torch.zeros(2, 1, 2, dtype=torch.long), 0, 16, 10)
        (10, 0)
    """
    row, col = places[edge % 2, color].tolist()
    down, right = _along(edge, side, reach)
    return row + down, col + right


class PatchSearch(NamedTuple):
    """The search for patches with cheap seams among them.

    Args:
        exemplar: (c, hz, wz).
        side: of a tile.
        reach: pixels of a patch on either side of its edge.
        allowed: (m, 2) places for patches of horizontal edges, and for those of vertical ones.
        colors: of either kind.
        generator: of the places tried.
    """

    exemplar: Tensor
    side: int
    reach: int
    allowed: list[Tensor]
    colors: int
    generator: torch.Generator

    def chosen(self, choice: Choice, on_step: Callable[[Stage], None] | None) -> Tensor:
        """(2, colors, 2): the best places found."""
        best, least = None, float("inf")
        for number in range(choice.tries):
            if on_step is not None:
                on_step(Stage(number / choice.tries / 2, "choose patches", self.exemplar))
            places = torch.stack([self._draw(axis, self.colors) for axis in (0, 1)])
            for _ in range(choice.rounds):
                cost = 0.0
                for color, axis in product(range(self.colors), (0, 1)):
                    cost = self._improve(places, axis, color, choice.candidates)
            if best is None or cost < least:
                best, least = places, cost
        assert best is not None
        return best

    def _draw(self, axis: int, count: int) -> Tensor:
        allowed = self.allowed[axis]
        drawn = torch.randint(len(allowed), (count,), generator=self.generator)
        return allowed[drawn.to(allowed.device)]

    def _improve(self, places: Tensor, axis: int, color: int, candidates: int) -> float:
        """Puts the best of some candidates and the present patch in its place."""
        tried = torch.cat([places[axis, color][None], self._draw(axis, candidates)])
        cost = self._costs(tried, places[1 - axis], axis)
        others = torch.cat([places[axis, :color], places[axis, color + 1 :]])
        near = (tried[:, None] - others).abs().amax(2).amin(1)
        # two colours with one patch would be one colour
        cost = cost * (1 + 4 * (1 - near / (self.side // 2)).clamp(min=0))
        best = int(cost.argmin())
        places[axis, color] = tried[best]
        return float(cost[best])

    def _costs(self, tried: Tensor, others: Tensor, axis: int) -> Tensor:
        """Costs of the seams, in the four corners of a tile, of patches with all the other axis's.

        In every row of a quarter the least squared error near the diagonal, blurred a little
        along it: nearly that of the best path, for many patches at once.
        """
        total = torch.zeros(len(tried), dtype=torch.float64, device=tried.device)
        barred = ~_band(self.side // 2, tried.device)
        for edge, across in product((axis, axis + 2), (1 - axis, 3 - axis)):
            row, column = (edge, across) if axis == 0 else (across, edge)
            ours = self._quarters(tried, edge, row, column)
            for theirs in self._quarters(others, across, row, column):
                error = (ours - theirs).square_().sum(1)
                error[:, 1:-1] += error[:, :-2] + error[:, 2:]
                least = error.masked_fill_(barred, torch.inf).amin(2)
                total += least.double().sum(1)
        return total

    def _quarters(self, places: Tensor, edge: int, row: int, column: int) -> Tensor:
        """(n, c, half, band) pixels of patches in a quarter of a tile, near its diagonal."""
        half = self.side // 2
        rows = torch.arange(half, device=places.device)[:, None]
        cols = (rows + _aside(half, places.device)).clamp(0, half - 1)
        rows = rows if row == NORTH else self.side - 1 - rows
        cols = cols if column == WEST else self.side - 1 - cols
        down, right = _along(edge, self.side, self.reach)
        width = self.exemplar.shape[2]
        corner = (places[:, 0] + down) * width + places[:, 1] + right
        at = corner[:, None, None] + rows * width + cols
        return self.exemplar.flatten(1)[:, at].transpose(0, 1)


class Assembly:
    """Cuts tiles, by their colours.

    Args:
        exemplar: (c, hz, wz).
        places: (2, colors, 2) of the patches of horizontal and of vertical edges.
        side: of a tile.
        reach: pixels of a patch on either side of its edge.
        cut: "mincut" or "dp".
        solver: of "mincut"; None for the first one that is installed.
    """

    def __init__(
        self,
        exemplar: Tensor,
        places: Tensor,
        side: int,
        reach: int,
        cut: str,
        solver: MinCut | None,
    ) -> None:
        self.exemplar, self.places, self.side, self.reach = exemplar, places, side, reach
        self.solver, self.views = solver, patch_views(exemplar)
        self.pieces = self._by_cut if cut == "mincut" else self._by_paths

    def __call__(self, colors: list[int]) -> Int[Tensor, "s s"]:
        """The edge whose patch each pixel shows."""
        return self.pieces(colors)

    def pixels(self, colors: list[int], pieces: Int[Tensor, "s s"]) -> Tensor:
        """The tile."""
        tile = self.exemplar.new_zeros(len(self.exemplar), self.side, self.side)
        for edge in range(4):
            rows, cols = _part(edge, self.side, self.reach)
            here = pieces[rows, cols] == edge
            shown = self._shown(self.exemplar[None], edge, colors[edge])[0]
            tile[:, rows, cols] = torch.where(here, shown, tile[:, rows, cols])
        return tile

    def _shown(self, views: Tensor, edge: int, color: int) -> Tensor:
        """The half of a patch, and a little more, that lies on the tile's side of its edge."""
        down, right = shift(edge, self.places, color, self.side, self.reach)
        rows, cols = _part(edge, self.side, self.reach)
        return views[
            ..., rows.start + down : rows.stop + down, cols.start + right : cols.stop + right
        ]

    def _by_cut(self, colors: list[int]) -> Tensor:
        """South and north first, then west and east over both, then once more around."""
        canvas = self.views.new_zeros(*self.views.shape[:2], self.side, self.side)
        pieces = torch.full((self.side, self.side), SOUTH, device=canvas.device)
        rows, cols = _part(SOUTH, self.side, self.reach)
        canvas[..., rows, cols] = self._shown(self.views, SOUTH, colors[SOUTH])
        empty = torch.ones_like(pieces, dtype=torch.bool)
        empty[rows, cols] = False
        for edge in (NORTH, WEST, EAST, NORTH, SOUTH, WEST, EAST):
            rows, cols = _part(edge, self.side, self.reach)
            first, second = self._held(edge)
            missing = empty[rows, cols]
            new = self._shown(self.views, edge, colors[edge])
            old = canvas[..., rows, cols]
            labels = cut_patch(
                old, new, first[rows, cols] & ~missing, second[rows, cols] | missing,
                solver=self.solver,
            )  # fmt: skip
            canvas[..., rows, cols] = torch.where(labels, new, old)
            pieces[rows, cols] = torch.where(labels, edge, pieces[rows, cols])
            empty[rows, cols] = False
        return pieces

    def _held(self, edge: int) -> tuple[Tensor, Tensor]:
        """Pixels of a tile that must not show a patch, and those that must: its own edge."""
        border = torch.ones(self.side, self.side, dtype=torch.bool, device=self.views.device)
        border[1:-1, 1:-1] = False
        own = torch.zeros_like(border)
        if edge % 2 == 0:  # horizontal edges have the corners
            own[0 if edge == NORTH else -1] = True
        else:
            own[1:-1, 0 if edge == WEST else -1] = True
        first = border & ~own
        # and where the patch ends
        rows, cols = _part(edge, self.side, self.reach)
        if edge % 2 == 0:
            first[rows.stop - 1 if edge == NORTH else rows.start] = True
        else:
            first[:, cols.stop - 1 if edge == WEST else cols.start] = True
        return first, own

    def _by_paths(self, colors: list[int]) -> Tensor:
        """A path from each corner to the centre."""
        half, side = self.side // 2, self.side
        pieces = torch.zeros(side, side, dtype=torch.long, device=self.views.device)
        shown = {}
        for edge in range(4):
            rows, cols = _part(edge, side, self.reach)
            shown[edge] = self.exemplar.new_zeros(len(self.exemplar), side, side)
            shown[edge][:, rows, cols] = self._shown(self.exemplar[None], edge, colors[edge])[0]
        band, aside = _band(half, self.views.device), _aside(half, self.views.device)
        line = torch.arange(half, device=self.views.device)
        offset = line - line[:, None]
        for row, column in product((NORTH, SOUTH), (WEST, EAST)):
            turned = [axis for axis, far in ((-2, row == SOUTH), (-1, column == EAST)) if far]
            a, b = (shown[edge].flip(turned)[:, :half, :half] for edge in (row, column))
            error = (a - b).square().sum(0).gather(1, (line[:, None] + aside).clamp(0, half - 1))
            barred = 1 + 2 * half * error.max()
            path = aside[dp_seam(torch.where(band, error, barred))]
            inside = (offset > path[:, None]) | (line[:, None] == 0)
            quarter = torch.where(inside, row, column).flip(turned)
            rows = slice(half, side) if row == SOUTH else slice(0, half)
            cols = slice(half, side) if column == EAST else slice(0, half)
            pieces[rows, cols] = quarter
        return pieces


def _part(edge: int, side: int, reach: int) -> tuple[slice, slice]:
    """Rows and columns of a tile that the patch of an edge covers."""
    whole, near, far = slice(0, side), slice(0, reach), slice(side - reach, side)
    return ((near, whole), (whole, far), (far, whole), (whole, near))[edge]


def _aside(half: int, device: torch.device) -> Int[Tensor, "w"]:
    """Columns away from the diagonal of a quarter that a path may go."""
    return torch.arange(-(half // 2), half // 2 + 1, device=device)


def _band(half: int, device: torch.device) -> Bool[Tensor, "s w"]:
    """Where a path from the corner of a quarter to its end may run: a diamond on the diagonal."""
    row = torch.arange(half, device=device)[:, None]
    aside = _aside(half, device)
    left = torch.minimum(row, (half - 1 - row).clamp(min=1))
    return (aside <= torch.minimum(row, half - 2 - row)) & (aside >= -left)
