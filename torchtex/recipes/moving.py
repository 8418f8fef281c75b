"""Moves of the pieces that make up a frame: along the flow, over each other, new ones.

Which piece shows at a pixel is a labeling, carried from frame to frame and improved by min-cuts.
Its energy has three terms: seams that show, pieces whose motion differs from the flow, and pixels
that differ from the warped frame before: the soft constraint of the paper.

Source: Kwatra et al. 2005, section 4.1 (what a frame should be), 2003 (costs of seams).
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.cuts.mincut import MinCut
from torchtex.cuts.seams import cut_patch, present_seams
from torchtex.recipes.frame_squares import Spot, fullest, kept, rim_of, spot_of
from torchtex.recipes.piece_motion import advanced, middles, speeds, within
from torchtex.recipes.piece_search import best_part, excess_of, use_of
from torchtex.recipes.pieces import OLD, Pieces, Stock
from torchtex.sources import pixel_places

INSIDE = 0.02
"""Weight of a pixel to be replaced, against 1 of those around, in the search for a piece."""

MARGIN = 8
"""How far a piece may grow in one frame, in pixels."""


@dataclass(frozen=True)
class Costs:
    """Weights of the energy of a frame, against 1 for the costs of seams.

    Args:
        follow: of the difference between a piece's motion and the flow, in pixels, per pixel.
        hold: of the difference to the warped frame before.
        repeat: of parts of the exemplar that a frame shows already, in the search for new pieces.
        balance: of a pixel from a part that the frame before shows twice as often as usual. What
            is flat meets anything without a seam, and would crowd out the rest.

    Example:
        >>> Costs().hold
        0.1
    """

    follow: float = 0.01
    hold: float = 0.1
    repeat: float = 1.0
    balance: float = 0.045


class Canvas:
    """A frame in the making. Its moves change which piece shows where.

    Args:
        pieces: of the frame before.
        stock: what they are of.
        flow: (2, h, w), from that frame to this one.
        costs: weights of the energy.
        solver: of the min-cuts.
        last: the frame before; its structure tells how pieces move. Else they move on average.
        wished: that frame, warped. Else what the pieces show after their move is held to.
        usual: how often parts of exemplars are shown, of `use_of`. Else that does not matter.

    Example:
        >>> from torchtex.recipes.pieces import pieces_of, stock_of
        >>> places = torch.zeros(64, 64, 3, dtype=torch.long)
        >>> places[..., 1:] = pixel_places((64, 64))
        >>> pieces = pieces_of(places, 32, torch.Generator())
        >>> stock = stock_of([torch.rand(1, 64, 64)], None, (64, 64))
        >>> canvas = Canvas(pieces, stock, torch.ones(2, 64, 64))
        >>> canvas.move()
        >>> int((canvas.pieces.owner < 0).sum())
        127
    """

    def __init__(
        self,
        pieces: Pieces,
        stock: Stock,
        flow: Float[Tensor, "2 h w"],
        costs: Costs = Costs(),
        solver: MinCut | None = None,
        *,
        last: Float[Tensor, "c h w"] | None = None,
        wished: Float[Tensor, "c h w"] | None = None,
        usual: Sequence[Float[Tensor, "_ _"]] | None = None,
    ) -> None:
        self.pieces, self.stock, self.costs, self.solver = pieces, stock, costs, solver
        self.flow = flow.permute(1, 2, 0).double()
        self.here = pixel_places(stock.size, flow.device)
        self.speed = speeds(pieces, self.flow, last)
        self.middle = middles(pieces, stock)
        self.excess = [] if usual is None else excess_of(use_of(pieces, stock), usual)
        self.bare = pieces.owner < 0  # pixels that no piece of the frame before has come to
        self.wished, self.views, self.prior = wished, torch.empty(0), torch.empty(0)

    def move(self) -> None:
        """Every piece a step further; where two come to lie on each other, the truer one."""
        self.pieces, self.bare = advanced(self.pieces, self.stock, self.flow, self.speed)
        self.middle = middles(self.pieces, self.stock)

    def drop(self, least: int) -> None:
        """Takes away pieces of fewer pixels."""
        owner = self.pieces.owner
        count = torch.bincount(owner[owner >= 0], minlength=len(self.pieces.which))
        small = (count < least)[owner.clamp(min=0)] & (owner >= 0)
        self.pieces = replace(self.pieces, owner=torch.where(small, -1, owner))
        self.bare = self.bare | small

    def grow(self, *, anywhere: bool = False) -> None:
        """Pixels of no piece go to a neighbor that can show there.

        Args:
            anywhere: to any neighbor, if need be beyond the border of its exemplar.
        """
        p, owner = self.pieces, self.pieces.owner.clone()
        steps = torch.tensor([[0, 1], [1, 0], [0, -1], [-1, 0]], device=owner.device)
        fresh = left = self.here[owner < 0]
        while len(left):
            near, inside = within(self.stock, left[:, None] + steps)
            who = torch.where(inside, owner[near[..., 0], near[..., 1]], -1)
            one, spot = who.clamp(min=0), left[:, None].expand(-1, 4, -1)
            off = (self.flow[left[:, 0], left[:, 1]][:, None] - self.speed[one]).square().sum(-1)
            possible = (who >= 0) & (anywhere | self._able(one, spot))
            least, pick = torch.where(possible, off, torch.inf).min(1)
            good = least.isfinite()
            if not bool(good.any()):
                break
            taken = one.gather(1, pick[:, None])[:, 0]
            owner[left[good, 0], left[good, 1]] = taken[good]
            left = left[~good]
        before, age, at = p.before.clone(), p.age.clone(), (fresh[:, 0], fresh[:, 1])
        before[at], age[at] = owner[at], OLD
        self.pieces = replace(p, owner=owner, before=before, age=age)

    def show(self) -> None:
        """Looks at what the pieces show now; changes are measured against it."""
        owner = self.pieces.owner.clamp(min=0)
        self.views = self._seen(owner, self.here)
        self.prior = self.views[0].clone() if self.wished is None else self.wished

    def cover(self, most: int) -> int:
        """New pieces where no old one reaches, the largest hole first; returns how many."""
        half = max(1, self.stock.side // 2)
        for made in range(most):
            holes = (self.pieces.owner < 0).double()
            corner = fullest(self.stock, holes, half)
            if corner is None or not self._put(corner, least=1):
                return made
        return most

    def renew(self, most: int, bar: float) -> int:
        """New pieces over the worst seams, where they make the frame better.

        Args:
            most: how many are tried.
            bar: cost of seams, per pixel of a line across a piece, below which none is.

        Returns:
            How many were put in.
        """
        side, made = self.stock.side, 0
        half = max(1, side // 2)
        tried = torch.zeros_like(self.bare)
        for _ in range(most):
            right, down = present_seams(self.views)
            seams = (F.pad(right, (0, 1)) + F.pad(down, (0, 0, 0, 1))).double()
            corner = fullest(self.stock, torch.where(tried, 0, seams), half, bar * half)
            if corner is None:
                break
            made += self._put(corner, least=side**2 // 8)
            tried[spot_of(self.stock, corner, (side, side))] = True
        return made

    def mend(self, least: int, some: Collection[int] | None = None) -> None:
        """Every piece takes those pixels around it that make the frame better.

        Args:
            least: pixels that a piece must have to grow.
            some: only pieces of these numbers.
        """
        count = torch.bincount(self.pieces.owner.flatten(), minlength=len(self.pieces.which))
        for number in (count >= least).nonzero()[:, 0].tolist():
            if some is None or number in some:
                self._expand(number)

    def done(self, fade: int) -> Pieces:
        """The pieces that are still to be seen; all pixels have become a frame older."""
        p = self.pieces
        owner = p.owner.clamp(min=0)  # where neither old pieces nor new ones fit
        age = (p.age + 1).clamp(max=OLD)
        before = torch.where(age > fade, owner, p.before)
        used, index = torch.stack([owner, before]).unique(return_inverse=True)
        return Pieces(index[0], index[1], age, p.which[used], p.source[used], p.place[used])

    def _able(self, owner: Tensor, at: Tensor) -> Tensor:
        """Whether pieces can show at those places."""
        near = self.stock.wrapped(at - self.middle[owner]).square().sum(-1) <= self.stock.reach**2
        units = self.stock.units(self.pieces, owner, at)
        return near & self.stock.free(self.pieces.which[owner], units)

    def _seen(self, owner: Tensor, at: Tensor) -> Tensor:
        """Views of what pieces show at those places."""
        return self.stock.views(self.pieces.which[owner], self.stock.units(self.pieces, owner, at))

    def _put(self, corner: tuple[int, int], least: int) -> int:
        """The part of an exemplar that fits there best, as a new piece.

        Returns:
            1, or 0 where nothing fits or it would show at fewer pixels.
        """
        stock, p = self.stock, self.pieces
        box = stock.side + 2 * stock.ring
        begin = kept(stock, (corner[0] - stock.ring, corner[1] - stock.ring), box)
        at = spot_of(self.stock, begin, (box, box))
        row, col = ((c - b) % e for c, b, e in zip(corner, begin, stock.size, strict=True))
        core = torch.zeros(box, box, dtype=torch.bool, device=at[0].device)
        core[row : row + stock.side, col : col + stock.side] = True
        old, holes = self.views[:, :, at[0], at[1]], p.owner[at] < 0
        weight = torch.where(holes, 0.0, torch.where(core, INSIDE, 1.0))
        used = use_of(p, stock)
        found = best_part(stock, old[0], weight, used, self.costs.repeat)
        if found is None:
            return 0
        spot = pixel_places((box, box), at[0].device)
        units = (spot + torch.tensor(found[1:], device=spot.device)) * stock.steps
        speed, which = self.flow[at][core].mean(0), torch.full_like(units[..., 0], found[0])
        new = stock.views(which, units)
        unary = self._unary(at, (old, new), speed, self._often(which, units))
        stays = rim_of(stock, begin, box) & ~holes
        labels = cut_patch(old, new, stays, holes, unary=unary, solver=self.solver)
        if int(labels.sum()) < least:
            return 0
        first = p.place.new_tensor([begin])
        self.pieces = replace(
            p,
            which=torch.cat([p.which, p.which.new_tensor([found[0]])]),
            source=torch.cat([p.source, p.source.new_tensor([found[1:]])]),
            place=torch.cat([p.place, first]),
        )
        self.speed = torch.cat([self.speed, speed[None]])
        self.middle = torch.cat([self.middle, first + spot[labels].double().mean(0)])
        self._paste(at, labels, len(p.which), new)
        return 1

    def _often(self, which: Tensor, units: Tensor) -> Tensor:
        """How much more often than usual the parts are shown that pixels come from."""
        found = torch.zeros_like(which, dtype=torch.float64)
        for number, excess in enumerate(self.excess):
            limit = units.new_tensor(excess.shape) - 1
            at = torch.minimum((units // self.stock.steps).clamp(min=0), limit)
            found = torch.where(which == number, excess[at[..., 0], at[..., 1]], found)
        return found

    def _unary(
        self, at: Spot, views: tuple[Tensor, Tensor], speed: Tensor, often: Tensor
    ) -> Tensor:
        """Costs of old and new pixels: not following the flow, changing, shown often elsewhere."""
        owner, prior = self.pieces.owner[at].clamp(min=0), self.prior[:, at[0], at[1]]
        units = self.stock.units(self.pieces, owner, self.here[at])
        before = self._often(self.pieces.which[owner], units)
        sides = []
        for view, moves, shown in zip(
            views, (self.speed[owner], speed), (before, often), strict=True
        ):
            off = (self.flow[at] - moves).square().sum(-1).sqrt()
            change = (view[0] - prior).square().sum(0).sqrt()
            change = torch.where(self.bare[at], 0, change)
            costs = self.costs
            sides.append(costs.follow * off + costs.hold * change + costs.balance * shown)
        return torch.stack(sides, -1).to(views[0])

    def _paste(self, at: Spot, labels: Tensor, number: int, new: Tensor) -> None:
        """Gives pixels to a piece. Those that had another one pass into it over some frames."""
        p = self.pieces
        owner, before, age = p.owner.clone(), p.before.clone(), p.age.clone()
        was = owner[at]
        gained = labels & (was != number)
        fades = gained & ~self.bare[at]
        before[at] = torch.where(fades, was, torch.where(gained, number, before[at]))
        age[at] = torch.where(fades, -1, torch.where(gained, OLD, age[at]))
        owner[at] = torch.where(labels, number, was)
        self.pieces = replace(p, owner=owner, before=before, age=age)
        self.views[:, :, at[0], at[1]] = torch.where(labels, new, self.views[:, :, at[0], at[1]])

    def _expand(self, number: int) -> None:
        """One piece takes pixels of others, within a margin."""
        stock, mine = self.stock, (self.pieces.owner == number).nonzero()
        if not len(mine):
            return
        centre = self.middle[number].round().long()
        gap = stock.wrapped(mine - centre).round().long()
        low, high = (gap.amin(0) + centre - MARGIN), (gap.amax(0) + centre + MARGIN + 1)
        if not stock.periodic:
            low, high = (
                torch.minimum(x.clamp(min=0), low.new_tensor(stock.size)) for x in (low, high)
            )
        count = torch.minimum(high - low, low.new_tensor(stock.size))
        at = spot_of(self.stock, (int(low[0]), int(low[1])), (int(count[0]), int(count[1])))
        here, own = self.here[at], self.pieces.owner[at] == number
        near = F.max_pool2d(own[None, None].float(), 2 * MARGIN - 1, 1, MARGIN - 1)[0, 0] > 0
        one = torch.full_like(here[..., 0], number)
        can = near & self._able(one, here)
        if not bool((can & ~own).any()):
            return
        which, units = self.pieces.which[one], stock.units(self.pieces, one, here)
        old, new = self.views[:, :, at[0], at[1]], stock.views(which, units)
        unary = self._unary(at, (old, new), self.speed[number], self._often(which, units))
        labels = cut_patch(old, new, ~can & ~own, own, unary=unary, solver=self.solver)
        if bool((labels & ~own).any()):
            self._paste(at, labels, number, new)
