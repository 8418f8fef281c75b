"""Holes taken apart: boxes around them, and how far around a box is looked."""

from collections.abc import Sequence

from jaxtyping import Bool
from torch import Tensor

from torchtex.cuts.laplace import bounding_box
from torchtex.label_spaces import label_space

Box = tuple[slice, slice]


def boxes_of(mask: Bool[Tensor, "h w"], gap: int) -> list[Box]:
    """Boxes that hold all of the mask, split where more than `gap` rows or columns are free.

    Example:
        >>> mask = torch.zeros(4, 12, dtype=torch.bool)
        >>> mask[1, 1] = mask[2, 9:11] = True
        >>> [(cols.start, cols.stop) for rows, cols in boxes_of(mask, 3)]
        [(1, 2), (9, 11)]
    """
    found: list[Box] = []
    todo = [bounding_box(mask)]
    while todo:
        box = todo.pop()
        for axis in (0, 1):
            taken = mask[box].any(1 - axis).nonzero().flatten()
            free = (taken.diff() > gap).nonzero().flatten()
            if len(free):
                middle = box[axis].start + int(taken[free[0]]) + 1
                for span in (slice(box[axis].start, middle), slice(middle, box[axis].stop)):
                    half = (span, box[1]) if axis == 0 else (box[0], span)
                    tight = bounding_box(mask[half])
                    todo.append(shifted(tight, half[0].start, half[1].start))
                break
        else:
            found.append(box)
    return sorted(found, key=lambda box: (box[0].start, box[1].start))


def around(
    box: Box, margin: int, reach: int, known: Bool[Tensor, "h w"], least: int
) -> tuple[Box, Box]:
    """What the solver makes, and where it may look; all of the image if that holds no window.

    Args:
        margin, reach: pixels around the box, of the two.
        known: pixels that may be copied.
        least: side of the smallest window.

    Example:
        >>> known = torch.ones(40, 60, dtype=torch.bool)
        >>> near, wide = around((slice(10, 14), slice(20, 24)), 4, 12, known, 8)
        >>> near[0], wide[1]
        (slice(6, 18, None), slice(8, 36, None))
    """
    near, wide = (_grown(box, by, known.shape) for by in (margin, max(margin, reach)))
    if not len(label_space([(known[wide].shape[0], known[wide].shape[1])], least, [known[wide]])):
        wide = (slice(0, known.shape[0]), slice(0, known.shape[1]))
    return near, wide


def _grown(box: Box, by: int, size: Sequence[int]) -> Box:
    rows, cols = (
        slice(max(0, s.start - by), min(n, s.stop + by)) for s, n in zip(box, size, strict=True)
    )
    return rows, cols


def shifted(box: Box, rows: int, cols: int) -> Box:
    """The box moved.

    Example:
        >>> shifted((slice(0, 2), slice(1, 3)), 1, -1)
        (slice(1, 3, None), slice(0, 2, None))
    """
    return (
        slice(box[0].start + rows, box[0].stop + rows),
        slice(box[1].start + cols, box[1].stop + cols),
    )
