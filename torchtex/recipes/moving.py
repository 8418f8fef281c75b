"""Moves of the pieces that make up a frame: along the flow, over each other, new ones.

Which piece shows at a pixel is a labeling, carried from frame to frame and improved by min-cuts.
Its energy has three terms: seams that show, pieces whose motion differs from the flow, and pixels
that change against the frame before.

Source: Kwatra et al. 2005, section 4.1 (what a frame should be), 2003 (costs of seams).
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut
from torchtex.cuts.seams import cut_patch, present_seams
from torchtex.recipes.pieces import OLD, Pieces, Stock, means
from torchtex.sources import pixel_places

INSIDE = 0.02
"""Weight of a pixel to be replaced, against 1 of those around, in the search for a piece."""

MARGIN = 8
"""How far a piece may grow in one frame, in pixels."""

Spot = tuple[Tensor, Tensor]
"""Rows (n, 1) and columns (1, m) of a rectangle, around the border of a tile."""


@dataclass(frozen=True)
class Costs:
    """Weights of the energy of a frame, against 1 for the costs of seams.

    Args:
        follow: of the difference between a piece's motion and the flow, in pixels, per pixel.
        hold: of the difference to the frame before, where a pixel changes its piece.
        repeat: of parts of the exemplar that a frame shows already, in the search for new pieces.

    Example:
        >>> Costs().hold
        0.1
    """

    follow: float = 0.03
    hold: float = 0.1
    repeat: float = 1.0


class Canvas:
    """A frame in the making. Its moves change which piece shows where.

    Args:
        pieces: of the frame before.
        stock: what they are of.
        flow: (2, h, w), from that frame to this one.
        costs: weights of the energy.
        solver: of the min-cuts.

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
    ) -> None:
        self.pieces, self.stock, self.costs, self.solver = pieces, stock, costs, solver
        self.flow = flow.permute(1, 2, 0).double()
        self.here = pixel_places(stock.size, flow.device)
        self.speed = means(self.flow.reshape(-1, 2), pieces.owner.flatten(), len(pieces.which))
        self.middle = self._middles()
        self.bare = pieces.owner < 0  # pixels that no piece of the frame before has come to
        self.views = self.prior = torch.empty(0)

    def move(self) -> None:
        """Every piece by its mean flow; where two come to lie on each other, the truer one."""
        p, (h, w) = self.pieces, self.stock.size
        place = p.place + self.speed
        shift = ((place + 0.5).floor() - (p.place + 0.5).floor()).long()
        to, inside = self._inside(self.here + shift[p.owner])
        off = (self.flow - self.speed[p.owner]).square().sum(-1).sqrt()
        # the least number wins: first by the difference, then by the place, so that none are equal
        rank = (off * 256).clamp(max=2**20).long() * (h * w) + _flat(self.here, w)
        nobody = 2**62
        best = torch.full((h * w,), nobody, dtype=torch.long, device=to.device)
        best = best.scatter_reduce(0, _flat(to, w)[inside], rank[inside], "amin")
        self.bare = (best == nobody).view(h, w)
        source = torch.where(best < nobody, best % (h * w), 0)
        owner, before, age = (x.flatten()[source].view(h, w) for x in (p.owner, p.before, p.age))
        owner = torch.where(self.bare, -1, owner)
        self.pieces = replace(p, owner=owner, before=before, age=age, place=place)
        self.middle = self._middles()

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
            near, inside = self._inside(left[:, None] + steps)
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
        self.prior = self.views[0].clone()

    def cover(self, most: int) -> int:
        """New pieces where no old one reaches, the largest hole first; returns how many."""
        half = max(1, self.stock.side // 2)
        for made in range(most):
            holes = (self.pieces.owner < 0).double()
            corner = self._largest(holes, half)
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
            corner = self._largest(torch.where(tried, 0, seams), half, bar * half)
            if corner is None:
                break
            made += self._put(corner, least=side**2 // 8)
            tried[self._spot(corner, (side, side))] = True
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

    def _inside(self, at: Int[Tensor, "*n 2"]) -> tuple[Int[Tensor, "*n 2"], Tensor]:
        """Places in the frame, and which of them were in it before."""
        extent = torch.tensor(self.stock.size, device=at.device)
        if self.stock.periodic:
            return at.remainder(extent), torch.ones_like(at[..., 0], dtype=torch.bool)
        inside = ((at >= 0) & (at < extent)).all(-1)
        return torch.minimum(at.clamp(min=0), extent - 1), inside

    def _middles(self) -> Float[Tensor, "k 2"]:
        p = self.pieces
        has = p.owner >= 0
        gap = self.stock.wrapped(self.here[has] - p.place[p.owner[has]])
        return p.place + means(gap, p.owner[has], len(p.which))

    def _able(self, owner: Tensor, at: Tensor) -> Tensor:
        """Whether pieces can show at those places."""
        near = self.stock.wrapped(at - self.middle[owner]).square().sum(-1) <= self.stock.reach**2
        units = self.stock.units(self.pieces, owner, at)
        return near & self.stock.free(self.pieces.which[owner], units)

    def _seen(self, owner: Tensor, at: Tensor) -> Tensor:
        """Views of what pieces show at those places."""
        return self.stock.views(self.pieces.which[owner], self.stock.units(self.pieces, owner, at))

    def _largest(self, what: Tensor, half: int, bar: float = 0.0) -> tuple[int, int] | None:
        """Corner of the piece around the square of that side that holds most; None up to a bar."""
        stock, total = self.stock, what[None, None]
        if stock.periodic:
            total = F.pad(total, (0, half - 1, 0, half - 1), mode="circular")
        mean = F.avg_pool2d(total, half, 1)[0, 0]
        top = int(mean.argmax())
        if float(mean.flatten()[top]) * half**2 <= bar:
            return None
        found = [at - (stock.side - half) // 2 for at in divmod(top, mean.shape[1])]
        return self._kept((found[0], found[1]), stock.side)

    def _kept(self, corner: tuple[int, int], side: int) -> tuple[int, int]:
        """The corner moved so that a square of that side is in the frame."""
        row, col = (
            at % extent if self.stock.periodic else min(max(at, 0), extent - side)
            for at, extent in zip(corner, self.stock.size, strict=True)
        )
        return row, col

    def _spot(self, corner: tuple[int, int], extent: tuple[int, int]) -> Spot:
        rows, cols = (
            (first + torch.arange(count, device=self.here.device)) % whole
            for first, count, whole in zip(corner, extent, self.stock.size, strict=True)
        )
        return rows[:, None], cols[None]

    def _put(self, corner: tuple[int, int], least: int) -> int:
        """The part of an exemplar that fits there best, as a new piece.

        Returns:
            1, or 0 where nothing fits or it would show at fewer pixels.
        """
        stock, p = self.stock, self.pieces
        box = stock.side + 2 * stock.ring
        begin = self._kept((corner[0] - stock.ring, corner[1] - stock.ring), box)
        at = self._spot(begin, (box, box))
        row, col = ((c - b) % e for c, b, e in zip(corner, begin, stock.size, strict=True))
        core = torch.zeros(box, box, dtype=torch.bool, device=at[0].device)
        core[row : row + stock.side, col : col + stock.side] = True
        old, holes = self.views[:, :, at[0], at[1]], p.owner[at] < 0
        weight = torch.where(holes, 0.0, torch.where(core, INSIDE, 1.0))
        found = self._search(old[0], weight)
        if found is None:
            return 0
        spot = pixel_places((box, box), at[0].device)
        units = (spot + torch.tensor(found[1:], device=spot.device)) * stock.steps
        new = stock.views(torch.full_like(units[..., 0], found[0]), units)
        speed = self.flow[at][core].mean(0)
        unary = self._unary(at, old, new, speed)
        stays = self._rim(begin, box) & ~holes
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

    def _rim(self, begin: tuple[int, int], box: int) -> Tensor:
        """Outermost pixels of a square, but for those at the border of the frame."""
        rim = torch.zeros(box, box, dtype=torch.bool, device=self.here.device)
        for axis in (0, 1):
            for end, border in ((0, 0), (-1, self.stock.size[axis] - box)):
                if self.stock.periodic or begin[axis] != border:
                    rim.select(axis, end).fill_(True)
        return rim

    def _search(self, wished: Tensor, weight: Tensor) -> tuple[int, int, int] | None:
        """Exemplar, row and column of what fits best and is not shown too often already."""
        best, found, box = math.inf, None, len(weight)
        if not bool((weight > 0).any()):
            weight = torch.ones_like(weight)
        for number, (search, used) in enumerate(
            zip(self.stock.searches, self._used(), strict=True)
        ):
            if search is None:
                continue
            cost = search(wished[None], weight.to(wished))[0] + 1e-4 * float(weight.sum())
            shown = F.avg_pool2d(used[None, None], box, 1)[0, 0]
            cost = cost * (1 + self.costs.repeat * shown)
            top = int(cost.argmin())
            if float(cost.flatten()[top]) < best:
                best = float(cost.flatten()[top])
                found = (number, *divmod(top, cost.shape[1]))
        return found

    def _used(self) -> list[Float[Tensor, "_ _"]]:
        """How often each pixel of each exemplar is shown, over the mean of that."""
        p, stock, counts = self.pieces, self.stock, []
        has = p.owner >= 0
        owner = p.owner[has]
        places = stock.units(p, owner, self.here[has]) // stock.steps
        for number, usable in enumerate(stock.usable):
            h, w = usable.shape
            mine = places[p.which[owner] == number]
            flat = mine[:, 0].clamp(0, h - 1) * w + mine[:, 1].clamp(0, w - 1)
            counts.append(torch.bincount(flat, minlength=h * w).view(h, w).double())
        mean = max(len(owner), 1) / sum(int(usable.sum()) for usable in stock.usable)
        return [count / mean for count in counts]

    def _unary(self, at: Spot, old: Tensor, new: Tensor, speed: Tensor) -> Tensor:
        """Costs of what does not follow the flow, and of what changes, for old and new pixels."""
        owner, prior = self.pieces.owner[at].clamp(min=0), self.prior[:, at[0], at[1]]
        sides = []
        for view, moves in ((old[0], self.speed[owner]), (new[0], speed)):
            off = (self.flow[at] - moves).square().sum(-1).sqrt()
            change = (view - prior).square().sum(0).sqrt()
            change = torch.where(self.bare[at], 0, change)
            sides.append(self.costs.follow * off + self.costs.hold * change)
        return torch.stack(sides, -1).to(old)

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
        at = self._spot((int(low[0]), int(low[1])), (int(count[0]), int(count[1])))
        here, own = self.here[at], self.pieces.owner[at] == number
        near = F.max_pool2d(own[None, None].float(), 2 * MARGIN - 1, 1, MARGIN - 1)[0, 0] > 0
        one = torch.full_like(here[..., 0], number)
        can = near & self._able(one, here)
        if not bool((can & ~own).any()):
            return
        old, new = self.views[:, :, at[0], at[1]], self._seen(one, here)
        unary = self._unary(at, old, new, self.speed[number])
        labels = cut_patch(old, new, ~can & ~own, own, unary=unary, solver=self.solver)
        if bool((labels & ~own).any()):
            self._paste(at, labels, number, new)


def _flat(at: Int[Tensor, "*n 2"], width: int) -> Int[Tensor, "*n"]:
    return at[..., 0] * width + at[..., 1]
