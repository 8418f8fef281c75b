"""Histograms of exemplar and volume: how far apart, and weights that draw them together."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def earth_mover(
    a: Float[Tensor, "c *space"], b: Float[Tensor, "c *other"], *, quantiles: int = 1024
) -> Float[Tensor, "c"]:
    """Earth mover's distance between the values of each channel of two images or volumes.

    The mean distance between equal quantiles; 0.01 is one hundredth of the range 0..1.

    Example:
        >>> earth_mover(torch.zeros(1, 4, 4), torch.full((1, 2, 2, 2), 0.25)).tolist()
        [0.25]
    """
    rank = (torch.arange(quantiles, dtype=torch.float64, device=a.device) + 0.5) / quantiles
    found = []
    for one, two in zip(a.flatten(1), b.flatten(1), strict=True):
        ends = []
        for values in (one, two):
            place = rank * len(values) - 0.5
            low = place.floor().clamp(0, len(values) - 1)
            high = (low + 1).clamp(max=len(values) - 1)
            ordered = values.sort().values
            share = (place - low).clamp(0, 1).to(ordered)
            ends.append(torch.lerp(ordered[low.long()], ordered[high.long()], share))
        found.append((ends[0] - ends[1]).abs().mean())
    return torch.stack(found)


def bins_of(values: Float[Tensor, "c *space"], bins: int = 16) -> Int[Tensor, "c *space"]:
    """Bin of each value of [0, 1]; what lies outside is in the first or the last.

    Example:
        >>> bins_of(torch.tensor([[-1.0, 0.1, 0.99, 1.0]])).tolist()
        [[0, 1, 15, 15]]
    """
    return (values * bins).long().clamp_(0, bins - 1)


def excess(
    exemplar: Float[Tensor, "c m"],
    volume: Float[Tensor, "c v"],
    *,
    bins: int = 16,
    used: Bool[Tensor, "m"] | None = None,
) -> Float[Tensor, "m"]:
    """How much too frequent the values of each exemplar pixel are in the volume.

    sum over channels j of max(0, H_v,j(b) - H_e,j(b)) / H_e,j(b), b the bin of the pixel's value.
    A contribution to a voxel has its weight divided by 1 + this, so that the colours of a volume
    stay those of its exemplar and its mean does not fade to grey.

    Args:
        used: pixels of the exemplar that its histogram is made of; all unless given.

    Source: Kopf et al. 2007, section 3.2; relative to H_e, so that rare values count too.

    Example:
        >>> excess(torch.tensor([[0.0, 1.0]]), torch.tensor([[0.0, 0.0, 0.0, 1.0]])).tolist()
        [0.5, 0.0]
    """
    total = exemplar.new_zeros(exemplar.shape[1])
    for ours, theirs in zip(bins_of(exemplar, bins), bins_of(volume, bins), strict=True):
        own = ours if used is None else ours[used]
        held = torch.bincount(own, minlength=bins).to(total) / len(own)
        made = torch.bincount(theirs, minlength=bins).to(total) / len(theirs)
        over = (made - held).clamp(min=0) / held.clamp(min=1 / len(own))
        total += over[ours]
    return total
