"""Deformed layers put together: seams by min-cut where they overlap, a mask where none is.

Layers are laid down one after another. Where a layer meets what is there, the seam between both
minimises

    W(s, t) = |C_i(s) - C_j(s)| + |C_i(t) - C_j(t)|

over neighbouring pixels s and t. The paper leaves open what keeps the seam from going around a
layer that lies wholly on another, which would be cheapest: here the inside of the later layer, all
that is farther than `band` pixels from its border, stays. Slivers that are left between seams show
nothing, and become holes too.

Source: Shen et al. 2006, Completion-based texture design, section 3.4, equations 3 and 4.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.cuts.laplace import bounding_box
from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.cuts.seams import FLOOR, cut_seam
from torchtex.layers.deform import Deformed
from torchtex.patches import box_sums, summed_area

Window = tuple[slice, slice]
Index = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Part:
    """A deformed layer, or a child of one, and where it lies.

    Args:
        deformed: its pixels, where they come from, and its mask.
        at: row and column of its first pixel; it may hang out of the canvas.
        exemplar: number of the picture that it is from.
        whole: it is shown up to its border, however small it is, where none lies over it.
        core: the pixels of the mask that are its own; others, a collar around them, are only
            there for seams to run through. None for all of them.
        firm: the pixels that a seam may not run through, whatever lies there, if they are farther
            than the band from the core's border. None for all of them.
    """

    deformed: Deformed
    at: tuple[int, int] = (0, 0)
    exemplar: int = 0
    whole: bool = False
    core: Bool[Tensor, "h w"] | None = None
    firm: Bool[Tensor, "h w"] | None = None


@dataclass(frozen=True)
class Stitched:
    """Layers in one picture.

    Args:
        texture: (c, h, w); 0 in the holes.
        positions: exemplar, row and column of every pixel; 0 in the holes.
        owner: number of the part that each pixel shows, -1 for none.
    """

    texture: Float[Tensor, "c h w"]
    positions: Float[Tensor, "h w 3"]
    owner: Int[Tensor, "h w"]

    @property
    def holes(self) -> Bool[Tensor, "h w"]:
        """True where no layer is: the complement of the mask of equation 4."""
        return self.owner < 0


def stitch(
    parts: Sequence[Part],
    size: tuple[int, int],
    *,
    band: int = 4,
    narrowest: int = 5,
    gradient: bool = False,
    solver: MinCut | None = None,
) -> Stitched:
    """Parts laid over each other, the first one lowest, joined along seams of least cost.

    Args:
        size: (height, width) of the canvas.
        band: pixels inside the border of a core that the seam may run through; of a part that is
            narrower, half of them, and one that has no inside then shows where it is cheap to.
        narrowest: side of a square; what is shown of a part is made of such squares, none of them
            alone or in a handful, and the rest of it is a hole.
        gradient: seams cost less along edges of the pictures, where they are hardly seen.
        solver: of the min-cuts; None for the first one that is installed.

    Raises:
        ValueError: no part, a negative band, or narrowest below 1.
        ImportError: no min-cut solver is installed.

    Example:
        >>> from torchtex.layers.deform import Deformation, deform
        >>> z = torch.rand(3, 12, 12)
        >>> left, right = (deform(z, Deformation((0.0, dx))) for dx in (-4.0, 4.0))
        >>> made = stitch([Part(left), Part(right)], (12, 14))
        >>> made.owner[0, 0].item(), made.owner[0, 11].item(), made.holes[:, 12:].all().item()
        (0, 1, True)
    """
    if not parts:
        raise ValueError("parts is empty; give at least one")
    if band < 0:
        raise ValueError(f"band={band} must be at least 0 pixels")
    if narrowest < 1:
        raise ValueError(f"narrowest={narrowest} must be at least 1 pixel")
    solver = default_solver() if solver is None else solver
    like = parts[0].deformed.texture
    texture = like.new_zeros(len(like), *size)
    positions = torch.zeros(*size, 3, device=like.device)
    owner = torch.full(size, -1, dtype=torch.long, device=like.device)
    for number, part in enumerate(parts):
        window, own, mask = _windows(part, size)
        if not bool(mask.any()):
            continue
        old, new = texture[:, window[0], window[1]], part.deformed.texture[:, own[0], own[1]]
        known = owner[window] >= 0
        core = mask if part.core is None else part.core[own] & mask
        shown = core
        if bool((known & mask).any()):
            firm = _inner(core, 0 if part.whole else band)
            firm = firm if part.firm is None else firm & part.firm[own]
            shown = _cut(old, new, known, core | (known & mask), firm, gradient, solver)
        source = _positions(part, own)
        texture[:, window[0], window[1]] = torch.where(shown, new, old)
        positions[window] = torch.where(shown[..., None], source, positions[window])
        owner[window] = torch.where(shown, number, owner[window])
    if narrowest > 1:
        whole = owner.new_tensor([n for n, part in enumerate(parts) if part.whole])
        kept = _wide(owner, narrowest) | torch.isin(owner, whole)
        owner = torch.where(kept, owner, -1)
    holes = owner < 0
    texture[:, holes], positions[holes] = 0.0, 0.0
    return Stitched(texture, positions, owner)


def _wide(owner: Tensor, side: int) -> Bool[Tensor, "h w"]:
    """Pixels in some square of one owner; squares may hang out of the canvas."""
    half = (side - 1) // 2
    around = (half, side - 1 - half) * 2
    x = owner[None].double()
    high = F.max_pool2d(F.pad(x, around, value=-2.0), side, 1)
    low = -F.max_pool2d(F.pad(-x, around, value=-torch.inf), side, 1)
    alike = (high == low) & (_seen(owner, 3 * side) >= 3 * side**2)
    return F.max_pool2d(F.pad(alike.double(), around[::-1]), side, 1)[0] > 0


def _seen(owner: Tensor, side: int) -> Float[Tensor, "h w"]:
    """Pixels of the same owner in a square around each pixel; beyond the canvas it goes on."""
    count = torch.zeros(owner.shape, dtype=torch.float64, device=owner.device)
    half = (side - 1) // 2
    around = (half, side - 1 - half) * 2
    wide = F.pad(owner[None].double(), around, mode="replicate")[0]
    for number in owner.unique().tolist():
        rows, cols = bounding_box(owner == number)
        near = wide[rows.start : rows.stop + side - 1, cols.start : cols.stop + side - 1]
        seen = box_sums(summed_area((near == number).double()), side, side)
        count[rows, cols] = torch.where(owner[rows, cols] == number, seen, count[rows, cols])
    return count


def _windows(part: Part, size: tuple[int, int]) -> tuple[Window, Index, Bool[Tensor, "h w"]]:
    """Rows and columns of the canvas under a part and around it, those of the part, its mask."""
    mask = part.deformed.mask
    canvas, own, inside = [], [], []
    for axis, (start, extent) in enumerate(zip(part.at, size, strict=True)):
        taken = mask.any(1 - axis).nonzero().flatten()
        first, last = (int(taken[0]), int(taken[-1]) + 1) if len(taken) else (0, 0)
        low = min(max(0, start + first - 1), extent)
        high = max(low, min(extent, start + last + 1))
        line = torch.arange(low - start, high - start, device=mask.device)
        canvas.append(slice(low, high))
        own.append(line.clamp(0, mask.shape[axis] - 1))
        inside.append((line >= 0) & (line < mask.shape[axis]))
    index = (own[0][:, None], own[1])
    return (canvas[0], canvas[1]), index, mask[index] & inside[0][:, None] & inside[1]


def _positions(part: Part, own: Index) -> Float[Tensor, "h w 3"]:
    layers = part.deformed.field.positions  # of a shrunk one, the middle of its samples
    found = layers[len(layers) // 2][own].float()
    found[..., 0] = part.exemplar
    return found


def _cut(
    old: Tensor, new: Tensor, known: Tensor, mask: Tensor, firm: Tensor, gradient: bool,
    solver: MinCut,
) -> Bool[Tensor, "h w"]:  # fmt: skip
    """Which pixels a new part covers: at least those that are firm, or that no other part has."""
    both = known & mask
    apart = torch.where(both, (old - new).square().sum(0).sqrt(), 0)
    costs = []
    for axis in (1, 0):
        count = both.shape[axis] - 1
        pairs = [both.narrow(axis, start, count) for start in (0, 1)]
        some = pairs[0].to(apart) + pairs[1]
        # a pixel beyond the overlap has one picture only: its neighbour counts for it
        total = apart.narrow(axis, 0, count) + apart.narrow(axis, 1, count)
        total = total * 2 / some.clamp(min=1)
        if gradient:
            slopes = [x.diff(dim=axis + 1).square().sum(0).sqrt() for x in (old, new)]
            inner = pairs[0] & pairs[1]
            slope = torch.where(inner, slopes[0] + slopes[1], 0)
            total = total / (2 * slope + FLOOR)
        costs.append(total)
    second = mask & (~known | firm)
    labels = cut_seam(costs[0], costs[1], known & ~mask, second, solver=solver)
    return labels & mask


def _inner(mask: Tensor, band: int) -> Bool[Tensor, "h w"]:
    """The pixels farther than the band from the mask's border; of narrow masks, half the band."""
    outside = (~mask)[None].float()
    for reach in (band, band // 2):
        near = F.max_pool2d(F.pad(outside, (reach,) * 4, value=1.0), 2 * reach + 1, 1)[0] > 0
        if bool((~near).any()):
            break
    return ~near
