"""A position drawn by the costs of all positions."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.quadratic import threads


def pick(
    costs: Float[Tensor, "rows cols"], tolerance: float, generator: torch.Generator
) -> tuple[int, int]:
    """A position drawn evenly from those whose cost is at most (1 + tolerance) times the least.

    Raises:
        ValueError: the tolerance is negative, or no cost is finite.

    Source: Efros and Freeman 2001, with a tolerance of 0.1.

    Example:
        >>> pick(torch.tensor([[3.0, 1.0, 2.0]]), 0.1, torch.Generator())
        (0, 1)
    """
    if not tolerance >= 0:
        raise ValueError(f"tolerance={tolerance} must be at least 0")
    flat = _finite_costs(costs)
    near = (flat <= (1 + tolerance) * flat.min()).nonzero()[:, 0]
    draw = torch.randint(len(near), (1,), generator=generator, device=generator.device)
    return divmod(int(near[int(draw)]), costs.shape[1])


def pick_soft(
    costs: Float[Tensor, "rows cols"], scale: float, generator: torch.Generator
) -> tuple[int, int]:
    """A position drawn with probability in proportion to exp(-cost / scale).

    Graphcut textures takes the cost per overlapping pixel, and k sigma^2 as the scale, with
    sigma^2 the variance of the exemplar's pixels and k from 0.001 (strict) to 1.

    Raises:
        ValueError: the scale is not positive, or no cost is finite.

    Source: Kwatra et al. 2003 (Graphcut textures), section 3.1, equation 3.

    Example:
        >>> pick_soft(torch.tensor([[3.0, 1.0, 2.0]]), 1e-3, torch.Generator())
        (0, 1)
    """
    if not scale > 0:
        raise ValueError(f"scale={scale} must be positive")
    flat = _finite_costs(costs).double()
    with threads(1):
        upto = torch.exp((flat.min() - flat) / scale).cumsum(0)
    draw = torch.rand(1, generator=generator, device=generator.device, dtype=torch.float64)
    found = torch.searchsorted(upto, draw.to(upto.device) * upto[-1], right=True)
    return divmod(min(int(found), len(flat) - 1), costs.shape[1])


def _finite_costs(costs: Tensor) -> Tensor:
    flat = costs.flatten()
    if bool(flat.isnan().any()):
        raise ValueError(f"costs hold NaN at {int(flat.isnan().sum())} positions; replace them")
    if not bool(flat.isfinite().any()):
        raise ValueError(f"costs: none of {len(flat)} is finite; allow more positions")
    return flat
