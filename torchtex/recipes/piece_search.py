"""Search for the part of an exemplar that a new piece shows."""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.recipes.pieces import Pieces, Stock
from torchtex.sources import pixel_places

_NEAR = 6  # pixels around one that are its part of an exemplar


def use_of(pieces: Pieces, stock: Stock) -> list[Float[Tensor, "_ _"]]:
    """How often each pixel of each exemplar is shown, over the mean of that.

    Example:
        >>> from torchtex.recipes.pieces import pieces_of, stock_of
        >>> places = torch.zeros(8, 8, 3, dtype=torch.long)
        >>> places[..., 1:] = pixel_places((8, 8))
        >>> pieces = pieces_of(places, 32, torch.Generator())
        >>> use_of(pieces, stock_of([torch.rand(1, 8, 8)], None, (8, 8), steps=1))[0].unique()
        tensor([1.], dtype=torch.float64)
    """
    has = pieces.owner >= 0
    owner, here = pieces.owner[has], pixel_places(stock.size, pieces.owner.device)
    places = stock.units(pieces, owner, here[has]) // stock.steps
    counts = []
    for number, usable in enumerate(stock.usable):
        h, w = usable.shape
        mine = places[pieces.which[owner] == number]
        flat = mine[:, 0].clamp(0, h - 1) * w + mine[:, 1].clamp(0, w - 1)
        counts.append(torch.bincount(flat, minlength=h * w).view(h, w).double())
    mean = max(len(owner), 1) / sum(int(usable.sum()) for usable in stock.usable)
    return [count / mean for count in counts]


def excess_of(
    used: Sequence[Float[Tensor, "_ _"]], usual: Sequence[Float[Tensor, "_ _"]]
) -> list[Float[Tensor, "_ _"]]:
    """How much more often than usual the parts of each exemplar are shown, as log2 in -2..2.

    Args:
        used, usual: of `use_of`.

    Example:
        >>> once = torch.ones(8, 8)
        >>> excess_of([3 * once], [once])[0].unique().tolist()
        [1.0]
    """
    found = []
    for maps in zip(used, usual, strict=True):
        now, before = (
            F.avg_pool2d(F.pad(one[None, None], (_NEAR,) * 4, mode="replicate"), 2 * _NEAR + 1, 1)
            for one in maps
        )
        found.append(((now + 1) / (before + 1)).log2().clamp(-2, 2)[0, 0])
    return found


def best_part(
    stock: Stock,
    wished: Float[Tensor, "c s s"],
    weight: Float[Tensor, "s s"],
    used: list[Float[Tensor, "_ _"]],
    repeat: float,
) -> tuple[int, int, int] | None:
    """Exemplar, row and column of the part that fits best and is not shown too often already.

    Args:
        wished: what is to be fitted.
        weight: of its pixels; all count alike where all are 0.
        used: of `use_of`.
        repeat: how much dearer a part is for every time that it is shown.

    Returns:
        The corner of the part; None where no exemplar has room for it.

    Example:
        >>> from torchtex.recipes.pieces import stock_of
        >>> z = torch.rand(1, 40, 40)
        >>> stock, used = stock_of([z], None, (40, 40), side=8), [torch.zeros(40, 40)]
        >>> best_part(stock, z[:, 3:15, 5:17], torch.ones(12, 12), used, 1.0)
        (0, 3, 5)
    """
    best, found, box = math.inf, None, len(weight)
    if not bool((weight > 0).any()):
        weight = torch.ones_like(weight)
    for number, (search, shown) in enumerate(zip(stock.searches, used, strict=True)):
        if search is None:
            continue
        cost = search(wished[None], weight.to(wished))[0] + 1e-4 * float(weight.sum())
        cost = cost * (1 + repeat * F.avg_pool2d(shown[None, None], box, 1)[0, 0])
        top = int(cost.argmin())
        if float(cost.flatten()[top]) < best:
            best = float(cost.flatten()[top])
            found = (number, *divmod(top, cost.shape[1]))
    return found
