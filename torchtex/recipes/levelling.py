"""Levels evened out along seams, but for edges between things of unlike colours.

Source: Perez et al. 2003; which edges are kept is ours.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.cuts.poisson import Guidance, solve

_UNLIKE = 0.25  # distance of colours from which on a seam is an edge of things, and stays one


def levelled(
    texture: Float[Tensor, "c h w"], slopes: Guidance, mask: Bool[Tensor, "h w"]
) -> Float[Tensor, "c h w"]:
    """The texture, found anew in the mask from the differences that its sources have.

    Args:
        slopes: those differences; on a seam, what both sides agree on.
        mask: pixels that may change. On its border slopes are followed wholly.

    Example:
        >>> texture = torch.tensor([[[0.2, 0.2, 0.3, 0.3]]])
        >>> flat = Guidance(torch.zeros(1, 1, 3), torch.zeros(1, 0, 4))
        >>> done = levelled(texture, flat, torch.tensor([[False, True, True, True]]))
        >>> [round(value, 2) for value in done.flatten().tolist()]
        [0.2, 0.2, 0.21, 0.21]
    """
    sides = []
    for axis, slope in ((1, slopes.right), (0, slopes.down)):
        n = slope.shape[axis + 1]
        inside = mask.narrow(axis, 0, n) & mask.narrow(axis, 1, n)
        sides.append(torch.where(inside, _kept(slope, texture.diff(dim=axis + 1)), slope))
    return solve(Guidance(sides[0], sides[1]), texture, mask, boundary="free").clamp(0, 1)


def _kept(slope: Float[Tensor, "k a b"], step: Float[Tensor, "k a b"]) -> Float[Tensor, "k a b"]:
    """The slope where it is near to the step there is, and the step where they are far apart.

    A change of light is levelled; two things of unlike colours keep the edge between them, or
    their colours would run into each other.
    """
    apart = (step - slope).square().sum(0) / _UNLIKE**2
    return slope + (step - slope) * (apart / (1 + apart))
