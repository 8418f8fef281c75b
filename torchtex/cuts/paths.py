"""Paths through an error: seams by dynamic programming, and the overlaps of a quilt.

`quilt_mask` joins a block by two paths, `quilt_cut` by one min-cut through the same overlap,
whose seam never costs more.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchtex.cuts.mincut import MinCut
from torchtex.cuts.seams import cut_patch


def dp_seam(error: Float[Tensor, "h w"], *, closed: bool = False) -> Int[Tensor, "h"]:
    """Columns of the path from top to bottom with the least sum of errors.

    From row to row the column changes by one at most. Of equal paths the straighter one wins,
    then the one to the left, seen from the bottom.

    Args:
        closed: the rows are periodic, so the last column too is at most one from the first.
            Exact: all first columns are tried, side by side (h w^2 sums).

    Raises:
        ValueError: an error is NaN or infinite, or there is none.

    Example:
        >>> dp_seam(torch.tensor([[1.0, 0.0, 1.0], [1.0, 1.0, 0.0]])).tolist()
        [1, 2]
    """
    w = error.shape[1]
    if not error.numel():
        raise ValueError(f"error has shape {tuple(error.shape)}; a seam needs at least one pixel")
    if not bool(error.isfinite().all()):
        raise ValueError("error has a value that is NaN or infinite; give finite errors")
    barred = torch.zeros(1, w, dtype=torch.bool, device=error.device)  # at the top
    outside = barred[0]  # at the bottom
    if closed:
        one = torch.ones(w, w, dtype=torch.bool, device=error.device)
        barred, far = one.triu(1) | one.tril(-1), one.triu(2) | one.tril(-2)
        start = _first_least(_sums(error, barred)[0].masked_fill(far, torch.inf).amin(1))
        barred, outside = barred[start : start + 1], far[start]
    sums, steps = _sums(error, barred)
    columns = [_first_least(sums[0].masked_fill(outside, torch.inf))]
    for step in reversed(steps):
        columns.append(columns[-1] + step[columns[-1]])
    return torch.tensor(columns[::-1], device=error.device)


def dp_mask(
    error: Float[Tensor, "h w"], axis: int = 0, *, closed: bool = False
) -> Bool[Tensor, "h w"]:
    """True beyond the seam of `dp_seam`; the pixels of the seam itself are False.

    Args:
        axis: along which the seam runs: 0 from top to bottom, True to the right of it; 1 from
            left to right, True below it.
        closed: as in `dp_seam`.

    Raises:
        ValueError: axis is neither 0 nor 1, or an error makes no sense.

    Example:
        >>> dp_mask(torch.tensor([[1.0, 0.0, 1.0], [1.0, 1.0, 0.0]])).tolist()
        [[False, False, True], [False, False, False]]
    """
    if axis not in (0, 1):
        raise ValueError(f"axis={axis} must be 0 (top to bottom) or 1 (left to right)")
    upright = error if axis == 0 else error.T
    seam = dp_seam(upright, closed=closed)
    mask = torch.arange(upright.shape[1], device=error.device) > seam[:, None]
    return mask if axis == 0 else mask.T


def quilt_mask(
    old: Float[Tensor, "c h w"], new: Float[Tensor, "c h w"], left: int, top: int
) -> Bool[Tensor, "h w"]:
    """Where a new block of a quilt covers the old picture: two paths of least squared error.

    One path runs down the left overlap, one along the top overlap; the new block lies to the
    right of the one and below the other.

    Args:
        old, new: the canvas under the block, and the block.
        left, top: columns and rows that overlap what is there; 0 for none.

    Raises:
        ValueError: an overlap larger than the block.

    Source: Efros and Freeman 2001, Image Quilting, section 2.1.

    Example:
        >>> block = torch.rand(3, 6, 6)
        >>> quilt_mask(torch.rand(3, 6, 6), block, 2, 0)[:, 2:].all().item()
        True
    """
    _check_overlap(new, left, top)
    error = (old - new).square().sum(0)
    mask = torch.ones_like(error, dtype=torch.bool)
    if left:
        mask[:, :left] &= dp_mask(error[:, :left], 0)
    if top:
        mask[:top] &= dp_mask(error[:top], 1)
    return mask


def quilt_cut(
    old: Float[Tensor, "5 c h w"],
    new: Float[Tensor, "5 c h w"],
    left: int,
    top: int,
    *,
    gradient: bool = False,
    solver: MinCut | None = None,
) -> Bool[Tensor, "h w"]:
    """The same as `quilt_mask` by one min-cut through the whole overlap, as of `cut_patch`.

    The outermost column of the left overlap and the outermost row of the top overlap stay old.

    Args:
        old, new: views of the canvas under the block, and of the block.
        left, top: columns and rows that overlap what is there; 0 for none.
        gradient: as in `seams.seam_costs`.
        solver: None for the first one that is installed.

    Raises:
        ValueError: an overlap larger than the block.

    Example:
        >>> from torchtex.cuts.seams import patch_views
        >>> old, new = patch_views(torch.rand(3, 6, 6)), patch_views(torch.rand(3, 6, 6))
        >>> quilt_cut(old, new, 2, 0)[:, 0].any().item()
        False
    """
    _check_overlap(new, left, top)
    first = torch.zeros(new.shape[2:], dtype=torch.bool, device=new.device)
    fresh = torch.ones_like(first)
    first[: min(top, 1)] = first[:, : min(left, 1)] = True
    fresh[:top] = fresh[:, :left] = False
    return cut_patch(old, new, first, fresh, gradient=gradient, solver=solver)


def _check_overlap(new: Tensor, left: int, top: int) -> None:
    h, w = new.shape[-2:]
    for name, width, extent in (("left", left, w), ("top", top, h)):
        if not 0 <= width <= extent:
            raise ValueError(f"{name}={width} must lie in 0..{extent}, the size of the block")


def _first_least(values: Tensor) -> int:
    return int((values == values.min()).nonzero()[0])


def _sums(error: Tensor, barred: Tensor) -> tuple[Tensor, list[list[int]]]:
    """Least sums down to each column of the last row, and the steps back up.

    Each row of `barred` (n, w) stands for other columns to begin with; steps are kept for one.
    """
    sums = error[0].masked_fill(barred, torch.inf)
    steps = []
    for row in error[1:]:
        wide = pad(sums, (1, 1), value=torch.inf)
        best = torch.minimum(torch.minimum(wide[:, :-2], wide[:, 2:]), sums)
        if len(sums) == 1:
            aside = torch.where(wide[0, :-2] == best[0], -1, 1)
            steps.append(aside.masked_fill(sums[0] == best[0], 0))
        sums = row + best
    return sums, torch.stack(steps).tolist() if steps else []
