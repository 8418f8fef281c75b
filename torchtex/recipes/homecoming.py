"""Loops: pieces on the way back to the first frame, and the pixels that have joined them."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.cuts.mincut import MinCut
from torchtex.cuts.seams import cut_seam, seam_costs
from torchtex.flow.warps import warp
from torchtex.image import resize
from torchtex.recipes.pieces import OLD, Pieces, Stock, rendered


@dataclass(frozen=True)
class Homecoming:
    """The way back to the first frame: frames that lead to it, and when each pixel joins them.

    Args:
        ways: the pieces one frame before the first one, two frames before it, and so on.
        turn: (h, w), share of the way after which a pixel has joined.
        stock: what the pieces are of.
        frames: of the whole animation.
        solver: of the min-cuts.
    """

    ways: Sequence[Pieces]
    turn: Float[Tensor, "h w"]
    stock: Stock
    frames: int
    solver: MinCut

    def left(self, number: int) -> int:
        """Frames until the first one comes again."""
        return self.frames - number

    def joined(
        self, pieces: Pieces, home: Tensor, backward: Tensor, number: int
    ) -> tuple[Pieces, Tensor]:
        """Pieces of a frame, and which of its pixels have joined; all have in the last frame."""
        stock, way = self.stock, self.ways[self.left(number) - 1]
        share = 1 - (self.left(number) - 1) / len(self.ways)
        before, after = (rendered(p, stock, 0)[0] for p in (pieces, way))
        wrap = (stock.periodic, stock.periodic)
        right, down = seam_costs(before, after, wrap=wrap)
        moved = warp(home[None].double(), backward.double(), periodic=stock.periodic, cubic=False)
        must = self.turn <= share
        costs = torch.stack([moved[0], 0.1 * (1 - moved[0])], -1)
        at_home = cut_seam(
            right, down, torch.zeros_like(must), must, unary=costs.to(right), solver=self.solver
        )
        both = [torch.cat(pair) for pair in zip(table(pieces), table(way), strict=True)]
        owner = torch.where(at_home, way.owner + len(pieces.which), pieces.owner)
        old = torch.where(at_home, owner, pieces.before)
        age = torch.where(at_home, OLD, pieces.age)
        return Pieces(owner, old, age, *both), at_home


def homecoming(
    ways: Sequence[Pieces], stock: Stock, frames: int, solver: MinCut, seed: int
) -> Homecoming:
    """The way home over given pieces; pixels join it in blobs of twice a piece, at random times.

    Example:
        >>> from torchtex.cuts.mincut import default_solver
        >>> from torchtex.recipes.pieces import stock_of
        >>> stock = stock_of([torch.rand(1, 16, 16)], None, (16, 16))
        >>> homecoming([], stock, 9, default_solver(), 0).turn.shape
        torch.Size([16, 16])
    """
    still = [
        Pieces(way.owner, way.owner, torch.full_like(way.age, OLD), *table(way)) for way in ways
    ]
    cells = [max(2, extent // (2 * stock.side)) for extent in stock.size]
    order = torch.rand(
        1, *cells, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    order = resize(order, stock.size).flatten().argsort(stable=True).argsort(stable=True)
    turn = (order.double() + 0.5).view(stock.size) / order.numel()
    return Homecoming(still, turn.to(stock.usable[0].device), stock, frames, solver)


def table(pieces: Pieces) -> tuple[Tensor, Tensor, Tensor]:
    """What is known of each piece: its exemplar, a pixel there, and where that is in the frame.

    Example:
        >>> one = torch.zeros(1, 1, dtype=torch.long)
        >>> spot = torch.ones(1, 2)
        >>> table(Pieces(one, one, one, one[0], spot, spot))[0].tolist()
        [0]
    """
    return pieces.which, pieces.source, pieces.place
