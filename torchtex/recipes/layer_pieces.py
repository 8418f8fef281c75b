"""Pieces of layers: what they are, and where an operation of a plan brings them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtex.layers.deform import Deformation, Deformed, warped
from torchtex.layers.plans import Operation
from torchtex.layers.segment import Segmentation
from torchtex.layers.stitch import Part
from torchtex.recipes.strokes import distance
from torchtex.sources import SourceField

GROUND = 1 / 6  # of the exemplar: larger pieces are ground
_OUTLINE = 3  # pixels around a thing that are shown with it
_TORN = 1 / 16  # of the exemplar: smaller pieces at its border are not moved


@dataclass(frozen=True)
class Piece:
    """A child layer, or a layer, where it lies in the canvas before it is deformed.

    Args:
        exemplar, layer: numbers of them.
        mask: its pixels in the exemplar.
        box: the rows and columns that hold them.
        shift: rows and columns from the exemplar to the canvas.
        still: it is small, and the border of the exemplar cuts it off: it stays where it is.
    """

    exemplar: int
    layer: int
    mask: Tensor
    box: tuple[slice, slice]
    shift: tuple[int, int]
    still: bool = False

    @property
    def area(self) -> int:
        """Pixels of it."""
        return int(self.mask.sum())


def pieces_of(
    zs: Sequence[Tensor],
    segmentations: Sequence[Segmentation],
    size: tuple[int, int],
    children: bool,
    generator: torch.Generator,
) -> list[Piece]:
    """The pieces of as many copies of exemplars as cover a canvas.

    Args:
        children: a piece is a child of a layer, rather than the layer.
        generator: draws the exemplars of the copies, where there are several.

    Example:
        >>> labels = torch.zeros(8, 8, dtype=torch.long)
        >>> labels[2:6, 2:6] = 1
        >>> z, made = torch.rand(1, 8, 8), Segmentation(labels, labels)
        >>> [piece.area for piece in pieces_of([z], [made], (8, 8), True, torch.Generator())]
        [48, 16]
    """
    pieces = []
    copies = _copies(zs, size, generator)
    for number, top, left in copies:
        made = segmentations[number]
        for mask, torn in _masks(made, children, len(copies) > 1):
            rows, cols = (mask.any(axis).nonzero().flatten() for axis in (1, 0))
            box = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1))
            low = (box[0].start + top, box[1].start + left)
            high = (box[0].stop + top, box[1].stop + left)
            if low[0] < size[0] and low[1] < size[1] and min(high) > 0:
                layer = int(made.labels[mask][0])
                pieces.append(Piece(number, layer, mask, box, (top, left), torn))
    return pieces


def _masks(made: Segmentation, children: bool, several: bool) -> list[tuple[Tensor, bool]]:
    """Those of the pieces, and whether they are torn.

    Inside a canvas of several copies torn ones are left out, if their layer has others.
    """
    labels = made.children if children else made.labels
    found: list[tuple[Tensor, bool]] = []
    for layer in range(made.count):
        mine = made.labels == layer
        masks = [labels == int(label) for label in labels[mine].unique()]
        torn = [_torn(mask) for mask in masks]
        if several:
            whole = [(mask, False) for mask, bad in zip(masks, torn, strict=True) if not bad]
            found += whole or [(mask, False) for mask in masks]
        else:
            found += zip(masks, torn, strict=True)
    return found


def _torn(mask: Tensor) -> bool:
    """Whether the border of the exemplar cuts off a small piece."""
    edge = mask[0].any() | mask[-1].any() | mask[:, 0].any() | mask[:, -1].any()
    return bool(edge) and int(mask.sum()) < _TORN * mask.numel()


def _copies(
    zs: Sequence[Tensor], size: tuple[int, int], generator: torch.Generator
) -> list[tuple[int, int, int]]:
    """Exemplar, top and left of the copies that cover the canvas: one if it has its size."""
    h, w = zs[0].shape[1], zs[0].shape[2]
    if (h, w) == size and len(zs) == 1:
        return [(0, 0, 0)]
    heights, widths = min(z.shape[1] for z in zs), min(z.shape[2] for z in zs)
    found = []
    for top in range(0, size[0], heights):
        for left in range(0, size[1], widths):
            found.append((int(torch.randint(len(zs), (1,), generator=generator)), top, left))
    return found


def part_of(
    z: Tensor, piece: Piece, operations: Sequence[Operation], size: tuple[int, int], collar: int = 0
) -> Part:
    """A piece deformed, in a window that holds it, with a collar of what lies around it.

    So a seam can pass beside a thing rather than through it. Where the frame of the exemplar cuts
    the piece off, nothing lies around it, and the seam may run as far inside instead.

    Example:
        >>> mask = torch.ones(4, 4, dtype=torch.bool)
        >>> piece = Piece(0, 0, mask, (slice(0, 4), slice(0, 4)), (10, 10))
        >>> made = part_of(torch.rand(1, 4, 4), piece, [Operation("rotate", "clockwise", 90.0)],
        ...                (30, 30))
        >>> int(made.deformed.mask.sum())
        16
    """
    rows, cols = piece.box
    middle = ((rows.start + rows.stop - 1) / 2, (cols.start + cols.stop - 1) / 2)
    place, matrix = list(middle), torch.eye(3, dtype=torch.float64)
    for one in () if piece.still else operations:  # each about where the piece is by then
        there = (place[0] + piece.shift[0], place[1] + piece.shift[1])
        step = deformation(one, min(z.shape[1:]), there, size)
        matrix = step.matrix((place[0], place[1])) @ matrix
        place = [place[0] + step.translate[0], place[1] + step.translate[1]]
    low, high = _window(piece.box, collar, matrix)
    matrix[0, 2] -= low[0]
    matrix[1, 2] -= low[1]
    size = (high[0] - low[0], high[1] - low[1])
    at = (low[0] + piece.shift[0], low[1] + piece.shift[1])
    near = _around(piece.box, collar + 1)
    start = (near[0].start, near[1].start)
    offset = torch.eye(3, dtype=torch.float64)
    offset[:2, 2] = torch.tensor(start, dtype=torch.float64)
    image, mask = z[:, near[0], near[1]], piece.mask[near]
    own = mask
    if collar and piece.area < GROUND * piece.mask.numel():  # a thing keeps its outline
        own = distance(mask, _OUTLINE) <= _OUTLINE
    band = 0 if piece.still else 2 * collar
    marks = torch.stack([own, own & _framed(piece.mask, band)[near]]).to(z)
    wide = distance(mask, collar) <= collar if collar else mask
    made = warped(torch.cat([image, marks]), matrix @ offset, size, wide)
    positions = made.field.positions + made.field.positions.new_tensor([0, *start])
    field = SourceField(positions, made.field.weights, ((z.shape[1], z.shape[2]),))
    core, firm = made.mask & (made.texture[len(z) :] > 1 - 1e-4)
    done = Deformed(made.texture[: len(z)], made.mask, field)
    return Part(done, at, piece.exemplar, core=core, firm=firm)


def _around(box: tuple[slice, slice], room: int) -> tuple[slice, slice]:
    """A box with some room around it, within the picture."""
    rows, cols = (slice(max(side.start - room, 0), side.stop + room) for side in box)
    return rows, cols


def _window(
    box: tuple[slice, slice], collar: int, matrix: Tensor
) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last row and column, and one more, of what a box with its collar becomes."""
    corners = torch.tensor(
        [
            [row, col, 1.0]
            for row in (box[0].start - collar, box[0].stop - 1 + collar)
            for col in (box[1].start - collar, box[1].stop - 1 + collar)
        ],
        dtype=torch.float64,
    )
    moved = (corners @ matrix.T)[:, :2]
    low = [math.floor(x) - 1 for x in moved.amin(0).tolist()]
    high = [math.ceil(x) + 2 for x in moved.amax(0).tolist()]
    return (low[0], low[1]), (high[0], high[1])


def _framed(mask: Tensor, band: int) -> Tensor:
    """A mask without what lies near the border of the exemplar."""
    inside = torch.zeros_like(mask)
    inside[band : mask.shape[0] - band, band : mask.shape[1] - band] = True
    return mask & inside


def deformation(
    operation: Operation, side: int, place: tuple[float, float], size: tuple[int, int]
) -> Deformation:
    """An operation as a deformation; a move that would leave the canvas goes the other way.

    Args:
        side: shorter side of the picture, that moves are shares of.
        place: row and column of the layer's middle in the canvas.
        size: of the canvas.

    Example:
        >>> deformation(Operation("translate", "up", 0.1), 50, (2.0, 9.0), (40, 40)).translate
        (5.0, 0.0)
    """
    amount = operation.amount
    if operation.kind == "rotate":
        return Deformation(rotate=amount if operation.direction == "anticlockwise" else -amount)
    if operation.kind == "scale":
        return Deformation(scale=amount)
    if operation.kind == "mirror":
        across = operation.direction == "left-right"
        return Deformation(mirror=across, flip=not across)
    axis = 0 if operation.direction in ("up", "down") else 1
    distance = float(round(amount * side))
    sign = -1.0 if operation.direction in ("up", "left") else 1.0
    if not 0 <= place[axis] + sign * distance < size[axis]:
        sign = -sign
    return Deformation((sign * distance, 0.0) if axis == 0 else (0.0, sign * distance))
