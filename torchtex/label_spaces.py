"""The neighborhoods of all exemplars as one label space, and their pixels as strips."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class LabelSpace:
    """All neighborhoods of all exemplars, numbered: one label space.

    Args:
        positions: (m, 3), exemplar, row and column of the first pixel of each neighborhood.
        tables: label of each (row, column) of each exemplar, -1 where there is none.
    """

    positions: Int[Tensor, "m 3"]
    tables: tuple[Int[Tensor, "_ _"], ...]

    def __len__(self) -> int:
        return len(self.positions)

    def at(self, positions: Int[Tensor, "*n 3"]) -> Int[Tensor, "*n"]:
        """Labels of positions, -1 where a position holds no whole, unmasked neighborhood."""
        which, row, col = positions.unbind(-1)
        labels = torch.full_like(which, -1)
        for number, table in enumerate(self.tables):
            h, w = table.shape
            inside = (which == number) & (row >= 0) & (row < h) & (col >= 0) & (col < w)
            found = table[row.clamp(0, h - 1), col.clamp(0, w - 1)]
            labels = torch.where(inside, found, labels)
        return labels


def label_space(
    shapes: Sequence[tuple[int, int]],
    size: int,
    masks: Sequence[Bool[Tensor, "_ _"] | None] | None = None,
    *,
    device: torch.device | None = None,
) -> LabelSpace:
    """Labels of every window of `size` pixels that lies inside an exemplar and its mask.

    Args:
        shapes: height and width of each exemplar.
        size: of the windows.
        masks: True where an exemplar may be used.
        device: of the result; the CPU unless given.

    Example:
        >>> len(label_space([(10, 12)], 8))
        15
    """
    positions, tables, count = [], [], 0
    for number, (h, w) in enumerate(shapes):
        table = torch.full((h, w), -1, dtype=torch.long)
        if h >= size and w >= size:
            free = torch.zeros(h, w, dtype=torch.bool)
            free[: h - size + 1, : w - size + 1] = True
            mask = None if masks is None else masks[number]
            if mask is not None:
                free[: h - size + 1, : w - size + 1] &= _all_inside(mask.cpu(), size)
            where = free.nonzero()
            table[free] = torch.arange(count, count + len(where))
            positions.append(torch.cat([torch.full((len(where), 1), number), where], 1))
            count += len(where)
        tables.append(table)
    every = torch.cat(positions) if positions else torch.zeros(0, 3, dtype=torch.long)
    return LabelSpace(every.to(device), tuple(table.to(device) for table in tables))


def _all_inside(mask: Tensor, size: int) -> Tensor:
    area = torch.nn.functional.avg_pool2d(mask[None].double(), size, 1)[0]
    return area > 1 - 0.5 / size**2


@dataclass(frozen=True)
class Strips:
    """Pixels of all exemplars in one table of rows, from which windows are copied quickly."""

    table: Float[Tensor, "t e"]
    starts: Int[Tensor, "m"]
    steps: Int[Tensor, "m"]
    size: int

    def patches(self, labels: Int[Tensor, "n"]) -> Float[Tensor, "n d"]:
        """Windows of labels: rows, columns, channels."""
        rows = self.starts[labels][:, None] + self.steps[labels][:, None] * torch.arange(
            self.size, device=labels.device
        )
        return self.table.index_select(0, rows.flatten()).view(len(labels), -1)


def strips(images: Sequence[Float[Tensor, "k _ _"]], space: LabelSpace, size: int) -> Strips:
    """The windows of `space` as a table; memory is that of the images, not of the windows."""
    k = images[0].shape[0]
    flat = torch.cat([z.permute(1, 2, 0).reshape(-1) for z in images])
    table = flat.as_strided((len(flat) // k - size + 1, size * k), (k, 1))
    which, row, col = space.positions.to(flat.device).unbind(1)
    areas = torch.tensor([0, *(z.shape[1] * z.shape[2] for z in images)]).cumsum(0)
    widths = torch.tensor([z.shape[2] for z in images]).to(which)[which]
    return Strips(table, areas.to(which)[which] + row * widths + col, widths, size)
