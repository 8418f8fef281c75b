"""Nearest neighborhoods: exact and approximate search."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def two_sided_minima(
    queries: Float[Tensor, "n d"], keys: Float[Tensor, "m d"], *, chunk: int = 4096
) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"], Float[Tensor, "m"]]:
    """Nearest key of every query, and distance from every key to its nearest query.

    One pass over the distance matrix, `chunk` queries at a time, serves both directions.

    Returns:
        Squared distance of each query to its nearest key, the index of that key, and the
        squared distance of each key to its nearest query.
    """
    key_norms = keys.square().sum(1)
    best = queries.new_empty(len(queries))
    labels = torch.empty(len(queries), dtype=torch.long, device=queries.device)
    used = queries.new_full((len(keys),), float("inf"))
    for start in range(0, len(queries), chunk):
        part = queries[start : start + chunk]
        # |q - k|^2 = |q|^2 + |k|^2 - 2 q.k, in one fused product
        squared = torch.addmm(key_norms, part, keys.T, alpha=-2)
        squared += part.square().sum(1, keepdim=True)
        best[start : start + chunk], labels[start : start + chunk] = squared.min(1)
        used = torch.minimum(used, squared.amin(0))
    return best.clamp_(min=0), labels, used.clamp_(min=0)
