"""What moved textures are compared with: warps of one picture along a flow."""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.flow.fields import Flow, field_at
from torchtex.flow.warps import invert, warp


def warped_frames(
    first: Float[Tensor, "c h w"], flow: Flow, frames: int, *, periodic: bool = False
) -> Iterator[Float[Tensor, "c h w"]]:
    """The plain warp: the first frame moved along, with nothing made new. For comparison.

    Each frame is read from the first one through the whole motion so far, so it is blurred once.

    Source: Kwatra et al. 2005, figure 7.

    Example:
        >>> from torchtex.flow.fields import Uniform
        >>> len(list(warped_frames(torch.rand(1, 8, 8), Uniform((0.0, 1.0)), 3)))
        3
    """
    size = (first.shape[1], first.shape[2])
    whole = torch.zeros(2, *size).to(first)
    yield first
    for frame in range(frames - 1):
        step = invert(field_at(flow, frame, size).to(first), periodic=periodic)[0].to(first)
        # back one frame, and from there as far as that frame already goes
        whole = step + warp(whole, step, periodic=periodic, cubic=False)
        yield warp(first, whole, periodic=periodic).clamp(0, 1)


def regenerated_frames(
    first: Float[Tensor, "c h w"],
    flow: Flow,
    frames: int,
    *,
    life: int = 16,
    periodic: bool = False,
) -> Iterator[Float[Tensor, "c h w"]]:
    """Warps that start anew every `life` frames, three of them faded into each other.

    Source: Neyret 2003, Advected textures; the rival of Kwatra et al. 2005, figure 7.

    Example:
        >>> from torchtex.flow.fields import Uniform
        >>> len(list(regenerated_frames(torch.rand(1, 8, 8), Uniform((0.0, 1.0)), 5)))
        5
    """
    if life < 3:
        raise ValueError(f"life={life} must be at least 3 frames")
    size = (first.shape[1], first.shape[2])
    starts = [-life * phase // 3 for phase in range(3)]
    ways = [torch.zeros(2, *size).to(first) for _ in starts]
    for frame in range(frames):
        if frame:
            step = invert(field_at(flow, frame - 1, size).to(first), periodic=periodic)[0]
            step = step.to(first)
            ways = [step + warp(way, step, periodic=periodic, cubic=False) for way in ways]
        ages = [(frame - start) % life for start in starts]
        ways = [torch.zeros_like(w) if a == 0 else w for a, w in zip(ages, ways, strict=True)]
        shares = [math.sin(math.pi * (age + 0.5) / life) ** 2 for age in ages]
        parts = [
            share * warp(first, way, periodic=periodic)
            for share, way in zip(shares, ways, strict=True)
        ]
        yield (sum(parts[1:], parts[0]) / sum(shares)).clamp(0, 1)
