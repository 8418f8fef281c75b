"""Mending of a montage: where pieces meet, windows across the seam are matched and averaged.

One iteration of texture optimisation, but only of the windows that hold pixels of several pieces.
All other pixels stay copies. Candidates are what continues the pieces in a window, and the nearest
of every second neighborhood of the exemplars.

Source: Kwatra et al. 2005, Algorithm 1; Tong et al. 2002 for the candidates.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.energy import embed
from torchtex.features import Pixels
from torchtex.label_spaces import LabelSpace, Strips, label_space, strips
from torchtex.matching import Exact, Index
from torchtex.neighborhoods import Grid, falloff
from torchtex.sources import SourceField

_SIZES = (8, 6, 4)
"""Of windows; the first that fits is taken, at steps of half of it."""

_R = 0.8
_MOST = 16384  # windows held in memory at a time


def mended(
    field: SourceField,
    exemplars: Sequence[Float[Tensor, "c _ _"]],
    masks: Sequence[Bool[Tensor, "_ _"] | None],
    *,
    periodic: bool = False,
) -> SourceField:
    """The field with several layers, that average windows where pieces meet.

    Args:
        field: of one layer, which copies pixels.
        exemplars, masks: those that it points into.
        periodic: seams across the border are mended too.

    Source: Pan et al. 2009, fig. 1, process E.

    Example:
        >>> from torchtex.sources import copied, pixel_places
        >>> places = torch.cat([torch.zeros(16, 16, 1).long(), pixel_places((16, 16))], 2)
        >>> places[:, 8:, 2] -= 5
        >>> exemplar = torch.rand(3, 16, 16)
        >>> len(mended(copied(places, ((16, 16),)), [exemplar], [None]).weights)
        4
    """
    source = field.source_map()
    h, w = source.shape[:2]
    shapes = [(z.shape[1], z.shape[2]) for z in exemplars]
    for size in _SIZES:
        space = label_space(shapes, size, masks, device=source.device)
        if len(space) and size <= min(h, w):
            break
    else:
        return field
    grid = Grid(h, w, size, size // 2, periodic)
    torn = _torn(source, grid)
    if not bool(torn.any()):
        return field
    touched = grid.scatter(torn.to(torch.float32)[:, None].expand(-1, size * size))[0] > 0
    near = grid.gather(touched[None].float()).any(1)
    texture = field.apply(exemplars)
    patches = _Patches.of(exemplars, space, size)
    labels, weights = [], []
    nx = grid.shape[1]
    for band in grid.bands(_MOST):
        pick = near[band.start * nx : band.stop * nx]
        sites = grid.sites[band.start * nx : band.stop * nx].to(source.device)[pick]
        vectors = embed(grid.gather(texture, band)[pick], size, Pixels())
        label = space.at(source[sites[:, 0], sites[:, 1]])
        open_ = torn[band.start * nx : band.stop * nx][pick] | (label < 0)
        offers = _continued(source, space, sites[open_], size)
        label[open_] = patches.nearest(vectors[open_], offers)
        labels.append(label)
        weights.append(patches.weights(vectors, label))
    sites = grid.sites.to(source.device)[near]
    layers, shares = _layers(source, grid, sites, space.positions[torch.cat(labels)],
                             torch.cat(weights))  # fmt: skip
    layers[:, ~touched] = source[~touched]
    shares[:, ~touched] = 0
    shares[0, ~touched] = 1
    return SourceField(layers, shares, field.shapes)


@dataclass(frozen=True)
class _Patches:
    """Neighborhoods of the exemplars, and an index over every second one.

    Args:
        some: labels of those in the index, which holds them at half their size.
    """

    space: LabelSpace
    table: Strips
    size: int
    some: Int[Tensor, "m"]
    index: Index

    @staticmethod
    def of(exemplars: Sequence[Tensor], space: LabelSpace, size: int) -> "_Patches":
        table = strips(exemplars, space, size)
        even = (space.positions[:, 1:] % 2 == 0).all(1)
        some = (even if bool(even.any()) else ~even).nonzero()[:, 0]
        keys = _halved(embed(table.patches(some), size, Pixels()), size)
        return _Patches(space, table, size, some, Exact().fit(keys))

    def gaps(self, vectors: Float[Tensor, "n d"], labels: Int[Tensor, "n"]) -> Tensor:
        """Squared distances."""
        return (vectors - embed(self.table.patches(labels), self.size, Pixels())).square().sum(1)

    def nearest(self, vectors: Float[Tensor, "n d"], offers: Int[Tensor, "n k"]) -> Tensor:
        """The best of the offers and of the nearest in the index."""
        best = self.some[self.index.search(_halved(vectors, self.size), 1)[1][:, 0]]
        cost = self.gaps(vectors, best)
        for offer in offers.unbind(1):
            label = torch.where(offer < 0, best, offer)
            other = self.gaps(vectors, label)
            best, cost = torch.where(other < cost, label, best), torch.minimum(other, cost)
        return best

    def weights(self, vectors: Float[Tensor, "n d"], labels: Int[Tensor, "n"]) -> Tensor:
        """Of windows in the average; see `TextureEnergy.site_weights`."""
        eps = 0.02 * vectors.shape[1] ** 0.5
        return (self.gaps(vectors, labels) + eps**2) ** (_R / 2 - 1)


def _halved(vectors: Float[Tensor, "n d"], size: int) -> Float[Tensor, "n q"]:
    """Windows of half the size: four pixels become one."""
    c, half = vectors.shape[1] // size**2, size // 2
    return vectors.view(len(vectors), half, 2, half, 2, c).sum((2, 4)).flatten(1)


def _torn(source: Int[Tensor, "h w 3"], grid: Grid) -> Bool[Tensor, "n"]:
    """Windows that hold pixels of several pieces."""
    size, device = grid.size, source.device
    rows, cols = grid.rows.to(device)[:, None], grid.cols.to(device)[None]
    torn = torch.zeros(grid.shape, dtype=torch.bool, device=device)
    for dim in (0, 1):
        step = source.new_tensor([0, 1 - dim, dim])
        apart = (source.roll(-1, dim) != source + step).any(-1)
        wide = torch.cat([apart, apart[:size]], 0)
        wide = torch.cat([wide, wide[:, :size]], 1)  # windows may wrap around
        sums = torch.nn.functional.pad(wide.double().cumsum(0).cumsum(1), (1, 0, 1, 0))
        bottom, right = rows + size - (1 - dim), cols + size - dim
        inside = sums[bottom, right] - sums[rows, right] - sums[bottom, cols] + sums[rows, cols]
        torn |= inside > 0.5
    return torn.flatten()


def _continued(
    source: Int[Tensor, "h w 3"], space: LabelSpace, sites: Int[Tensor, "n 2"], size: int
) -> Int[Tensor, "n 4"]:
    """Labels that continue the pieces at four pixels of each window, -1 where they leave."""
    h, w = source.shape[:2]
    offers, ends = [], (size // 4, size - 1 - size // 4)
    for down, right in ((i, j) for i in ends for j in ends):
        place = source[(sites[:, 0] + down) % h, (sites[:, 1] + right) % w]
        offers.append(space.at(place - place.new_tensor([0, down, right])))
    return torch.stack(offers, 1)


def _layers(
    source: Int[Tensor, "h w 3"],
    grid: Grid,
    sites: Int[Tensor, "n 2"],
    places: Int[Tensor, "n 3"],
    weights: Float[Tensor, "n"],
) -> tuple[Int[Tensor, "most h w 3"], Float[Tensor, "most h w"]]:
    """Sources of each pixel, one for each window that holds it, and their weights."""
    h, w, size = grid.height, grid.width, grid.size
    cover = grid.scatter(torch.ones(len(grid), size * size))
    layers = source[None].repeat(int(cover.max()), 1, 1, 1)
    shares = weights.new_zeros(layers.shape[:3])
    count = torch.zeros(h, w, dtype=torch.long, device=source.device)
    profile = falloff(size).to(weights)
    for i in range(size):
        for j in range(size):
            # the windows of one offset touch distinct pixels
            row, col = (sites[:, 0] + i) % h, (sites[:, 1] + j) % w
            layer = count[row, col]
            layers[layer, row, col] = places + places.new_tensor([0, i, j])
            shares[layer, row, col] = weights * profile[i, j]
            count[row, col] = layer + 1
    return layers, shares
