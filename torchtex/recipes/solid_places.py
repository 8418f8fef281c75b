"""Places in exemplars: pixels of several as one table, and where they lie at a finer scale."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.volumes.slices import PLANES


def table_of(pictures: Sequence[Float[Tensor, "k _ _"]]) -> Float[Tensor, "t k"]:
    """Pixels of all pictures, row by row."""
    return torch.cat([z.permute(1, 2, 0).reshape(-1, len(z)) for z in pictures])


def shapes_of(pictures: Sequence[Tensor]) -> tuple[tuple[int, int], ...]:
    """Height and width of each."""
    return tuple((z.shape[1], z.shape[2]) for z in pictures)


def coarse_mask(
    mask: Bool[Tensor, "h w"] | None, height: int, width: int
) -> Bool[Tensor, "h2 w2"] | None:
    """A mask at a coarser scale: True where all that a pixel covers may be used.

    Example:
        >>> coarse_mask(torch.tensor([[True, True, True, False]]), 1, 2).tolist()
        [[True, False]]
    """
    if mask is None:
        return None
    return F.adaptive_avg_pool2d(mask[None].double(), (height, width))[0] > 0.999


def usable(
    masks: Sequence[Tensor | None], shapes: Sequence[tuple[int, int]]
) -> Bool[Tensor, "t"] | None:
    """Which pixels of the table may be used; None for all."""
    if all(mask is None for mask in masks):
        return None
    every = [
        torch.ones(h * w, dtype=torch.bool) if mask is None else mask.flatten().cpu()
        for mask, (h, w) in zip(masks, shapes, strict=True)
    ]
    return torch.cat(every)


def places_of(
    pixel: Int[Tensor, "d h w"], shapes: Sequence[tuple[int, int]]
) -> Int[Tensor, "d h w 3"]:
    """Exemplar, row and column of pixels in the table, as 16-bit numbers.

    Example:
        >>> places_of(torch.full((1, 1, 1), 21), ((4, 4), (2, 3))).flatten().tolist()
        [1, 1, 2]
    """
    out = torch.zeros(*pixel.shape, 3, dtype=torch.int16, device=pixel.device)
    first = 0
    for number, (height, width) in enumerate(shapes):
        here = (pixel >= first) & (pixel < first + height * width)
        own = pixel[here] - first
        row = torch.div(own, width, rounding_mode="floor")
        which = torch.full_like(own, number)
        out[here] = torch.stack([which, row, own % width], 1).to(torch.int16)
        first += height * width
    return out


def finer_places(
    pixel: Int[Tensor, "d h w"],
    axis: Int[Tensor, "d h w"],
    coarse: Sequence[tuple[int, int]],
    fine: Sequence[tuple[int, int]],
    extent: Sequence[int],
    generator: torch.Generator | None = None,
) -> Int[Tensor, "d2 h2 w2"]:
    """Pixels of finer exemplars for the voxels of a finer volume: sharp from the first step on.

    A voxel came from a slice across `axis`; those that it becomes take, in that plane, the pixels
    that its exemplar pixel becomes.

    Args:
        coarse, fine: height and width of each exemplar at the two scales.
        extent: of the finer volume.
        generator: picks for each voxel one of the coarse ones around it, the nearer the likelier;
            without one it is the nearest, and the voxels of a coarse one are alike.
    """
    parents, shifts = [], []
    for dim, (many, few) in enumerate(zip(extent, pixel.shape, strict=True)):
        shape = [1, 1, 1]
        shape[dim] = many
        centre = (((torch.arange(many) + 0.5) * few / many) - 0.5).view(shape).expand(*extent)
        if generator is None:
            parent = centre.round().long().clamp(0, few - 1)
        else:
            parent = (centre + torch.rand(*extent, generator=generator)).floor().long()
        parents.append((parent % few).to(pixel.device))
        shifts.append((centre - parent).to(pixel.device))
    z, y, x = parents
    places = places_of(pixel, coarse)[z, y, x].long()
    across = axis[z, y, x]
    out = torch.zeros(*extent, dtype=torch.long, device=pixel.device)
    first = 0
    for number, (old, new) in enumerate(zip(coarse, fine, strict=True)):
        for cut, plane in enumerate(PLANES):
            here = (places[..., 0] == number) & (across == cut)
            spots = [
                ((places[..., 1 + n][here] + 0.5 + shifts[side][here]) * new[n] / old[n] - 0.5)
                .round()
                .long()
                .clamp_(0, new[n] - 1)
                for n, side in enumerate(plane)
            ]
            out[here] = first + spots[0] * new[1] + spots[1]
        first += new[0] * new[1]
    return out
