"""Squares of a frame: where one has most of something, its places, and its outermost pixels."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.recipes.pieces import Stock

Spot = tuple[Tensor, Tensor]
"""Rows (n, 1) and columns (1, m) of a rectangle, around the border of a tile."""


def fullest(
    stock: Stock, what: Float[Tensor, "h w"], half: int, bar: float = 0.0
) -> tuple[int, int] | None:
    """Corner of the piece around the square of side `half` that holds most; None up to a bar.

    Example:
        >>> from torchtex.recipes.pieces import stock_of
        >>> stock = stock_of([torch.rand(1, 32, 32)], None, (32, 32), side=8)
        >>> what = torch.zeros(32, 32)
        >>> what[10:14, 20:24] = 1.0
        >>> fullest(stock, what, 4), fullest(stock, what, 4, 16.0)
        ((8, 18), None)
    """
    total = what[None, None]
    if stock.periodic:
        total = F.pad(total, (0, half - 1, 0, half - 1), mode="circular")
    mean = F.avg_pool2d(total, half, 1)[0, 0]
    top = int(mean.argmax())
    if float(mean.flatten()[top]) * half**2 <= bar:
        return None
    found = [at - (stock.side - half) // 2 for at in divmod(top, mean.shape[1])]
    return kept(stock, (found[0], found[1]), stock.side)


def kept(stock: Stock, corner: tuple[int, int], side: int) -> tuple[int, int]:
    """The corner moved so that a square of that side is in the frame.

    Example:
        >>> from torchtex.recipes.pieces import stock_of
        >>> kept(stock_of([torch.rand(1, 32, 32)], None, (32, 32)), (-3, 30), 8)
        (0, 24)
    """
    row, col = (
        at % extent if stock.periodic else min(max(at, 0), extent - side)
        for at, extent in zip(corner, stock.size, strict=True)
    )
    return row, col


def spot_of(stock: Stock, corner: tuple[int, int], extent: tuple[int, int]) -> Spot:
    """The places of a rectangle.

    Example:
        >>> from torchtex.recipes.pieces import stock_of
        >>> stock = stock_of([torch.rand(1, 32, 32)], None, (32, 32), periodic=True)
        >>> spot_of(stock, (0, 31), (1, 2))[1].tolist()
        [[31, 0]]
    """
    device = stock.usable[0].device
    rows, cols = (
        (first + torch.arange(count, device=device)) % whole
        for first, count, whole in zip(corner, extent, stock.size, strict=True)
    )
    return rows[:, None], cols[None]


def rim_of(stock: Stock, corner: tuple[int, int], side: int) -> Bool[Tensor, "s s"]:
    """Outermost pixels of a square, but for those at the border of the frame.

    Example:
        >>> from torchtex.recipes.pieces import stock_of
        >>> stock = stock_of([torch.rand(1, 32, 32)], None, (32, 32))
        >>> rim_of(stock, (0, 5), 3).int().tolist()
        [[1, 0, 1], [1, 0, 1], [1, 1, 1]]
    """
    rim = torch.zeros(side, side, dtype=torch.bool, device=stock.usable[0].device)
    for axis in (0, 1):
        for end, border in ((0, 0), (-1, stock.size[axis] - side)):
            if stock.periodic or corner[axis] != border:
                rim.select(axis, end).fill_(True)
    return rim
