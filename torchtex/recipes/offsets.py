"""Offsets that a hole may be filled from: where its surroundings are found again.

An offset is a source less a place. What is known around a pixel at the rim of a hole is looked for
elsewhere in the photo; the place where it is found is likely to go on as the hole should.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.patches import SsdSearch, box_sums, ssd_search, summed_area

_SIDES = (24, 12)  # of the windows that are looked for


def fitting(known: Bool[Tensor, "h w"], side: int) -> int:
    """The largest side, up to the one wanted, of a window that is known whole; 0 for none.

    Example:
        >>> known = torch.ones(12, 20, dtype=torch.bool)
        >>> known[:, 9] = False
        >>> fitting(known, 32), fitting(known, 8)
        (10, 8)
    """
    table = summed_area(known.double())
    for s in range(min(side, *known.shape), 0, -1):
        if bool((box_sums(table, s, s) > s * s - 0.5).any()):
            return s
    return 0


def rim_offsets(
    image: Float[Tensor, "c h w"],
    known: Bool[Tensor, "h w"],
    target: Bool[Tensor, "h w"],
    count: int,
) -> Int[Tensor, "k 2"]:
    """Offsets to where windows around pixels at the rim of the hole are found again.

    Args:
        known: pixels that windows are compared by, and found among.
        target: the hole.
        count: how many at most; evenly along the rim.

    Example:
        >>> stripes = (torch.arange(32) % 8 / 8).expand(1, 32, 32)
        >>> hole = torch.zeros(32, 32, dtype=torch.bool)
        >>> hole[14:18, 14:18] = True
        >>> (rim_offsets(stripes, ~hole, hole, 8)[:, 1] % 8).unique().tolist()
        [0]
    """
    sides = sorted({fitting(known, side) for side in _SIDES} - {0}, reverse=True)
    rim = target & (F.max_pool2d((~target)[None].double(), 3, 1, 1)[0] > 0)
    pixels = rim.nonzero()
    if not sides or not len(pixels):
        return pixels.new_zeros((0, 2))
    middle = pixels.double().mean(0)
    turned = torch.atan2(*(pixels - middle).unbind(1)).argsort(stable=True)
    search = ssd_search(torch.where(known, image, 0))
    found = []
    for number, side in enumerate(sides):
        share = count // len(sides) + (number < count % len(sides))
        if not share:
            continue
        every = -(-len(pixels) // share)
        found.append(_found_again(image, known, pixels[turned[::every]], side, search))
    return torch.cat(found).unique(dim=0)


def _found_again(
    image: Tensor, known: Tensor, pixels: Tensor, side: int, search: SsdSearch
) -> Int[Tensor, "n 2"]:
    """Offsets of the best matches of windows around pixels."""
    room = pixels.new_tensor(known.shape) - side
    corners = torch.minimum((pixels - side // 2).clamp(min=0), room)
    boxes = [(slice(i, i + side), slice(j, j + side)) for i, j in corners.tolist()]
    zones = torch.stack([known[box] for box in boxes])
    seen = zones.flatten(1).any(1)
    if not bool(seen.any()):
        return corners[:0]
    windows = torch.stack([image[:, rows, cols] for rows, cols in boxes])
    costs = search(windows[seen], zones[seen])
    whole = box_sums(summed_area(known.double()), side, side) > side * side - 0.5
    best = costs.masked_fill(~whole, torch.inf).flatten(1).argmin(1)
    places = torch.stack([best // costs.shape[2], best % costs.shape[2]], 1)
    return places - corners[seen]


def frequent(moved: Int[Tensor, "n 2"], count: int) -> Int[Tensor, "k 2"]:
    """The most frequent rows.

    Example:
        >>> frequent(torch.tensor([[1, 2], [3, 4], [1, 2]]), 1).tolist()
        [[1, 2]]
    """
    kinds, times = moved.unique(dim=0, return_counts=True)
    return kinds[times.argsort(descending=True, stable=True)[:count]]
