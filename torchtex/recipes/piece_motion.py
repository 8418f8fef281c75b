"""How pieces of a frame move along a flow, and where they come to lie.

A piece is rigid and the flow is not, so a piece can follow it only so far. Its motion is the one
that moves its structure by what the flow says there; flat parts may move as they like.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.quadratic import rowwise_sum
from torchtex.recipes.pieces import Pieces, Stock, means
from torchtex.sources import pixel_places

_RIDGE = 0.3  # share of the mean structure tensor that draws a motion to the mean flow


def speeds(
    pieces: Pieces, flow: Float[Tensor, "h w 2"], last: Float[Tensor, "c h w"] | None = None
) -> Float[Tensor, "k 2"]:
    """Motion of each piece: the mean flow over it, or the one that changes the fewest pixels.

    To first order a motion v changes a pixel by its gradient times v - f, against what the flow f
    makes of it. The sum of squares over the piece is minimised, with a pull to the mean flow.

    Args:
        last: the frame that the pieces show; None for the mean flow.

    Example:
        >>> places = torch.zeros(8, 8, 3, dtype=torch.long)
        >>> places[..., 1:] = pixel_places((8, 8))
        >>> from torchtex.recipes.pieces import pieces_of
        >>> pieces = pieces_of(places, 32, torch.Generator())
        >>> flow = torch.zeros(8, 8, 2, dtype=torch.float64)
        >>> flow[:4, :, 1] = 1.0
        >>> speeds(pieces, flow).tolist()
        [[0.0, 0.5]]
        >>> last = torch.zeros(1, 8, 8)
        >>> last[:, :4, ::4] = 1.0  # all there is to see moves by a pixel
        >>> bool(speeds(pieces, flow, last)[0, 1] > 0.8)
        True
    """
    owner, count = pieces.owner.flatten(), len(pieces.which)
    own = owner.clamp(min=0)
    mean = means(flow.reshape(-1, 2)[owner >= 0], owner[owner >= 0], count)
    if last is None or min(last.shape[1:]) < 2:
        return mean
    down, right = (slope.double() for slope in torch.gradient(last, dim=(1, 2)))
    dd, dr, rr = (
        (one * two).sum(0).flatten() for one, two in ((down, down), (down, right), (right, right))
    )
    off = flow.reshape(-1, 2) - mean[own]
    pull = _RIDGE * rowwise_sum(dd + rr) / (2 * len(own))
    values = (dd + pull, dr, rr + pull, dd * off[:, 0] + dr * off[:, 1],
              dr * off[:, 0] + rr * off[:, 1])  # fmt: skip
    a, b, d, u, v = (
        torch.bincount(own, torch.where(owner >= 0, value, 0), minlength=count) for value in values
    )
    area = a * d - b * b
    step = torch.stack([d * u - b * v, a * v - b * u], -1) / area[:, None]
    return mean + torch.where(area[:, None] > 1e-12, step, 0)


def advanced(
    pieces: Pieces, stock: Stock, flow: Float[Tensor, "h w 2"], speed: Float[Tensor, "k 2"]
) -> tuple[Pieces, Bool[Tensor, "h w"]]:
    """Every piece a step further; where two come to lie on each other, the truer one shows.

    Returns:
        The pieces, and the pixels that none has come to; the owner of those is -1.

    Example:
        >>> from torchtex.recipes.pieces import pieces_of, stock_of
        >>> places = torch.zeros(64, 64, 3, dtype=torch.long)
        >>> places[..., 1:] = pixel_places((64, 64))
        >>> pieces = pieces_of(places, 64, torch.Generator())
        >>> stock = stock_of([torch.rand(1, 64, 64)], None, (64, 64))
        >>> flow = torch.ones(64, 64, 2, dtype=torch.float64)
        >>> moved, bare = advanced(pieces, stock, flow, speeds(pieces, flow))
        >>> moved.place - pieces.place, int(bare.sum())
        (tensor([[1., 1.]], dtype=torch.float64), 127)
    """
    h, w = stock.size
    here = pixel_places(stock.size, pieces.owner.device)
    place = pieces.place + speed
    shift = ((place + 0.5).floor() - (pieces.place + 0.5).floor()).long()
    to, inside = within(stock, here + shift[pieces.owner])
    off = (flow - speed[pieces.owner]).square().sum(-1).sqrt()
    # the least number wins: first by the difference, then by the place, so that none are equal
    rank = (off * 256).clamp(max=2**20).long() * (h * w) + _flat(here, w)
    nobody = 2**62
    best = torch.full((h * w,), nobody, dtype=torch.long, device=to.device)
    best = best.scatter_reduce(0, _flat(to, w)[inside], rank[inside], "amin")
    bare = (best == nobody).view(h, w)
    source = torch.where(best < nobody, best % (h * w), 0)
    owner, before, age = (
        x.flatten()[source].view(h, w) for x in (pieces.owner, pieces.before, pieces.age)
    )
    owner = torch.where(bare, -1, owner)
    return replace(pieces, owner=owner, before=before, age=age, place=place), bare


def within(stock: Stock, at: Int[Tensor, "*n 2"]) -> tuple[Int[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
    """Places brought into the frame, and which of them were in it before.

    Example:
        >>> from torchtex.recipes.pieces import stock_of
        >>> stock = stock_of([torch.rand(1, 8, 8)], None, (8, 8))
        >>> at, inside = within(stock, torch.tensor([[-1, 3], [2, 2]]))
        >>> at.tolist(), inside.tolist()
        ([[0, 3], [2, 2]], [False, True])
    """
    extent = torch.tensor(stock.size, device=at.device)
    if stock.periodic:
        return at.remainder(extent), torch.ones_like(at[..., 0], dtype=torch.bool)
    inside = ((at >= 0) & (at < extent)).all(-1)
    return torch.minimum(at.clamp(min=0), extent - 1), inside


def middles(pieces: Pieces, stock: Stock) -> Float[Tensor, "k 2"]:
    """The middle of what shows of each piece; its place where nothing does.

    Example:
        >>> from torchtex.recipes.pieces import pieces_of, stock_of
        >>> places = torch.zeros(9, 9, 3, dtype=torch.long)
        >>> pieces = pieces_of(places + 0, 32, torch.Generator())
        >>> middles(pieces, stock_of([torch.rand(1, 8, 8)], None, (9, 9))).shape
        torch.Size([81, 2])
    """
    has = pieces.owner >= 0
    owner, here = pieces.owner[has], pixel_places(stock.size, pieces.owner.device)[has]
    gap = stock.wrapped(here - pieces.place[owner])
    return pieces.place + means(gap, owner, len(pieces.which))


def _flat(at: Int[Tensor, "*n 2"], width: int) -> Int[Tensor, "*n"]:
    return at[..., 0] * width + at[..., 1]
