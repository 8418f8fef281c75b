"""Quadtree pyramid: the best few positions for one zone of a patch, found from coarse to fine."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.matching import Exact, Index, Matcher, principal_axes
from torchtex.patches import box_sums, ssd, summed_area
from torchtex.quadratic import threads
from torchtex.templates import known_exemplar, known_template

_FITTED = 2**22  # cell values of a pyramid made at a time
_SAMPLED = 1000  # patches that principal axes are made of


@dataclass(frozen=True)
class Qtp:
    """Quadtree pyramid: approximate search for one zone of a patch, made ready once.

    The zone is cut into cells of 2^level pixels a side, or what the zone leaves of them. At the
    coarsest level all positions are searched by the means of the cells, reduced to principal
    axes; the best go on to the next finer level, and the last few are ranked by their SSD. A
    distance at a level is a lower bound of the SSD: one coordinate more holds the norm of what
    the axes leave out, and (|a| - |b|)^2 <= |a - b|^2. Without it flat patches cannot be told
    from grainy ones.

    It is many times quicker than exhaustive search, but on exemplars of a few hundred pixels
    hardly quicker than the transforms of `ssd_search`, which are exact: it pays for hundreds of
    zones of one shape, searched in batches.

    Args:
        keep: how many go on from each level, the coarsest first; with two there are three levels.
        axes: principal axes at the coarsest level; None for all cells as they are.
        matcher: the search at the coarsest level.

    Source: Liang et al. 2001 (patch-based sampling), section 4; Shen 2010, section 3.4.

    Example:
        >>> z = torch.rand(3, 40, 40)
        >>> zone = torch.ones(12, 12, dtype=torch.bool)
        >>> zone[3:, 3:] = False
        >>> index = Qtp().fit(z, zone)
        >>> costs, positions = index.search(z[None, :, 9:21, 5:17], 1)
        >>> costs.item(), positions[0, 0].tolist()
        (0.0, [9, 5])
    """

    keep: tuple[int, ...] = (128, 24)
    axes: int | None = 64
    matcher: Matcher = field(default_factory=Exact)

    def __post_init__(self) -> None:
        if not self.keep or min(self.keep) < 1:
            raise ValueError(f"keep={self.keep} must name one or more counts of at least 1")
        if self.axes is not None and self.axes < 1:
            raise ValueError(f"axes={self.axes} must be at least 1, or None")

    def fit(
        self,
        exemplar: Float[Tensor, "c hz wz"],
        mask: Bool[Tensor, "h w"],
        usable: Bool[Tensor, "hz wz"] | None = None,
    ) -> "QtpIndex":
        """The index of all positions of a patch in the exemplar.

        Args:
            mask: the zone of the patch that is compared.
            usable: False at exemplar pixels that no match may touch.

        Raises:
            ValueError: the patch is larger than the exemplar, the mask is empty, or no position
                is left.
        """
        z, usable = known_exemplar(exemplar, usable)
        c, wz = z.shape[0], z.shape[2]
        with threads(1):
            mean = z.mean((1, 2), keepdim=True)
            z = z - mean if usable is None else torch.where(usable, z - mean, 0)
            zeros = z.new_zeros(c, *mask.shape)
            energy = ssd(z, zeros, mask, usable=usable)
            positions = energy.isfinite().nonzero()
            if not len(positions):
                raise ValueError("usable leaves no position for the patch; allow more pixels")
            levels = tuple(_level(z, mask, 2**i) for i in range(len(self.keep), -1, -1))
            places = positions[:, 0] * wz + positions[:, 1]
            axes = None if self.axes is None else _axes(levels[0], places, self.axes)
            batch = max(1, _FITTED // (c * len(levels[0].cells)))
            keys = torch.cat([_project(levels[0].at(p), axes) for p in places.split(batch)])
            energy = energy[energy.isfinite()]
            keys = _with_rest(keys, energy)
        index = self.matcher.fit(keys)
        return QtpIndex(mask, mean, levels, self.keep, axes, positions, places, energy, index)


@dataclass(frozen=True)
class QtpIndex:
    """An exemplar made ready for one zone, by `Qtp`.

    Args:
        mask: (h, w), the zone.
        mean: (c, 1, 1), taken off the exemplar and off templates.
        levels: the cells, the coarsest level first.
        keep: how many go on from each level.
        axes: principal axes of the coarsest level, or None.
        positions, places: allowed positions, (row, column) and as places in a flat image.
        energy: sum of squares of the zone at each of them.
        index: the search at the coarsest level.
    """

    mask: Tensor
    mean: Tensor
    levels: tuple["_Level", ...]
    keep: tuple[int, ...]
    axes: Tensor | None
    positions: Tensor
    places: Tensor
    energy: Tensor
    index: Index

    def search(
        self, templates: Float[Tensor, "n c h w"], k: int
    ) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k 2"]]:
        """The k best positions found for each template, best first.

        Returns:
            Their costs, which are those of `ssd` there, and their rows and columns. Fewer than k
            where the exemplar has fewer positions.

        Raises:
            ValueError: k exceeds what the last level keeps, or a template does not fit the index.

        Example:
            >>> z = torch.rand(1, 16, 16)
            >>> index = Qtp().fit(z, torch.ones(4, 4, dtype=torch.bool))
            >>> index.search(z[None, :, :4, :4], 5)[1].shape
            torch.Size([1, 5, 2])
        """
        if not 1 <= k <= min(self.keep):
            raise ValueError(f"k={k} must lie in 1..{min(self.keep)}, or raise keep={self.keep}")
        wanted = (self.mean.shape[0], self.mask.shape[0], self.mask.shape[1])
        if tuple(templates.shape[1:]) != wanted:
            raise ValueError(
                f"template has shape {tuple(templates.shape[1:])}; the index is for {wanted}"
            )
        t, _ = known_template(templates, self.mask, wanted)
        with threads(1):
            t = torch.where(self.mask, t - self.mean, 0)
            table = summed_area(t)
            queries = [level.of(t, table) for level in self.levels]
            energy = t.square().sum((1, 2, 3))
            coarse = _with_rest(_project(queries[0], self.axes), energy)
        found = self.index.search(coarse, self.keep[0])[1]
        with threads(1):
            for i, count in enumerate((*self.keep[1:], k), start=1):
                exact = i == len(self.keep)
                costs, found = self._best(self.levels[i], queries[i], energy, found, count, exact)
        return costs, self.positions[found]

    def _best(
        self,
        level: "_Level",
        queries: Tensor,
        energy: Tensor,
        found: Tensor,
        count: int,
        exact: bool,
    ) -> tuple[Tensor, Tensor]:
        """The nearest of the positions found so far, by the cells of one level."""
        costs = []
        for i, candidates in enumerate(found):
            query, keys = queries[i : i + 1], level.at(self.places[candidates])
            if not exact:  # there the cells leave nothing out
                query = _with_rest(query, energy[i : i + 1])
                keys = _with_rest(keys, self.energy[candidates])
            costs.append((keys - query).square().sum(1))
        ranked, order = torch.stack(costs).sort(dim=1, stable=True)
        return ranked[:, :count], found.gather(1, order[:, :count])


@dataclass(frozen=True)
class _Level:
    """One level of a pyramid: means of cells, each times the root of the cell's pixels.

    So squared distances of cell means add up to a lower bound of the SSD.

    Args:
        cells: (k, 4), first row, first column, height and width of each cell in the patch.
        images: (c, s hz wz), for each of s cell shapes the values at all places of the exemplar.
        offset: (k,), from a position's place in the exemplar to each cell's value in `images`.
    """

    cells: Tensor
    images: Tensor
    offset: Tensor

    def at(self, places: Int[Tensor, "n"]) -> Float[Tensor, "n d"]:
        """Cell values of the exemplar's patches there."""
        return self.images[:, places[:, None] + self.offset].transpose(0, 1).flatten(1)

    def of(self, t: Float[Tensor, "n c h w"], table: Tensor) -> Float[Tensor, "n d"]:
        """Cell values of templates, whose table of `summed_area` is given."""
        row, col, height, width = self.cells.T
        area = height * width
        if bool((area == 1).all()):  # as they are: the table would round them
            return t[..., row, col].flatten(1)
        below, right = row + height, col + width
        sums = table[..., below, right] - table[..., below, col]
        sums = sums - (table[..., row, right] - table[..., row, col])
        return (sums / area.sqrt()).to(t.dtype).flatten(1)


def _level(z: Tensor, mask: Tensor, block: int) -> _Level:
    cells = torch.tensor(_cells(mask, block), device=z.device)
    (c, h, w), table = z.shape, summed_area(z)
    shapes, kind = torch.unique(cells[:, 2:], dim=0, return_inverse=True)
    images = z.new_zeros(c, len(shapes), h, w)
    for i, (height, width) in enumerate(shapes.tolist()):
        sums = z if height == width == 1 else box_sums(table, height, width)
        images[:, i, : h - height + 1, : w - width + 1] = sums / (height * width) ** 0.5
    return _Level(cells, images.flatten(1), (kind * h + cells[:, 0]) * w + cells[:, 1])


def _cells(mask: Tensor, block: int) -> list[tuple[int, int, int, int]]:
    """Blocks of a mask cut into rectangles that are True all over: row, column, height, width."""
    h, w = mask.shape
    free = mask.tolist()
    cells = []
    for r, c in ((r, c) for r in range(0, h, block) for c in range(0, w, block)):
        bottom, right = min(r + block, h), min(c + block, w)
        for i, j in ((i, j) for i in range(r, bottom) for j in range(c, right)):
            if not free[i][j]:
                continue
            end = next((b for b in range(j, right) if not free[i][b]), right)
            last = next((a for a in range(i, bottom) if not all(free[a][j:end])), bottom)
            for a in range(i, last):
                free[a][j:end] = [False] * (end - j)
            cells.append((i, j, last - i, end - j))
    return cells


def _axes(level: _Level, places: Tensor, count: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)  # a choice of axes needs no other
    order = torch.randperm(len(places), generator=generator)[:_SAMPLED]
    return principal_axes(level.at(places[order.to(places.device)]), count, generator)


def _project(values: Tensor, axes: Tensor | None) -> Tensor:
    return values if axes is None else values @ axes


def _with_rest(keys: Tensor, energy: Tensor) -> Tensor:
    """Keys, and the norm of what they leave out of vectors of that energy."""
    rest = (energy - keys.square().sum(1)).clamp(min=0).sqrt()
    return torch.cat([keys, rest[:, None]], 1)
