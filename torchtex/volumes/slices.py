"""Slices of volumes: which way they lie, windows on many of them at once, planes at an angle."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

PLANES = ((1, 2), (0, 2), (1, 0))
"""Axes of the volume (depth, rows, columns = 0, 1, 2) that are the rows and the columns of the
slices across axis 0, 1 and 2. Rows of the volume are rows of both side views, so that a grain that
stands upright in a picture stands upright from the front and from the side."""


def slices_of(volume: Float[Tensor, "c d h w"], axis: int) -> Float[Tensor, "n c rows cols"]:
    """All slices across an axis, as pictures: a view.

    Args:
        axis: 0 across the depth, (h, w) from the front; 1 across the rows, (d, w) from above;
            2 across the columns, (h, d) from the side.

    Raises:
        ValueError: another axis.

    Example:
        >>> slices_of(torch.zeros(3, 4, 5, 6), 2).shape
        torch.Size([6, 3, 5, 4])
    """
    if axis not in (0, 1, 2):
        raise ValueError(f"axis={axis} must be 0, 1 or 2: depth, rows or columns")
    rows, cols = PLANES[axis]
    return volume.permute(1 + axis, 0, 1 + rows, 1 + cols)


def diagonal_slice(
    volume: Float[Tensor, "c d h w"], axis: int = 1, shift: int = 0
) -> Float[Tensor, "c rows cols"]:
    """A plane along an axis and the diagonal of the two others, at 45 degrees.

    Its pixels are one voxel apart in both directions, each the nearest voxel, and the volume is
    taken to repeat: a copy of voxels, as sharp as they are.

    Args:
        axis: that the plane holds; its rows run along it.
        shift: moves the plane along one of the other axes.

    Example:
        >>> diagonal_slice(torch.rand(3, 8, 10, 8)).shape
        torch.Size([3, 10, 11])
    """
    rest = [other for other in (0, 1, 2) if other != axis]
    planes = volume.permute(0, 1 + axis, *(1 + other for other in rest))
    first, second = planes.shape[2:]
    along = torch.arange(round(max(first, second) * 2**0.5)) / 2**0.5
    place = along.round().long()
    return planes[:, :, place % first, (place + shift) % second]


def tiled(
    volume: Float[Tensor, "c d h w"], size: tuple[int, int, int]
) -> Float[Tensor, "c d2 h2 w2"]:
    """A volume of another size, filled with copies of one that tiles, from its first corner on.

    Example:
        >>> tiled(torch.rand(3, 8, 8, 8), (16, 12, 8)).shape
        torch.Size([3, 16, 12, 8])
    """
    for dim, many in enumerate(size, 1):
        if volume.shape[dim] != many:
            place = torch.arange(many, device=volume.device) % volume.shape[dim]
            volume = volume.index_select(dim, place)
    return volume


@dataclass(frozen=True)
class Windows:
    """Windows on slices of rows x cols voxels that wrap around, `stride` apart from `offset` on.

    Slices are (n, rows, cols, k): the channels vary fastest. Work goes through padded slices, in
    which no window is cut; `at` shows there the pixels that lie at one place in all windows.

    Args:
        rows, cols: of the slices, at least `size`.
        size: of the windows.
        stride: from a window to the next, at most `size`; the last gap may be smaller.
        offset: row and column of the first window.

    Example:
        >>> Windows(10, 12, 8, 4).gather(torch.zeros(5, 10, 12, 3)).shape
        torch.Size([45, 192])
    """

    rows: int
    cols: int
    size: int
    stride: int
    offset: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        if not 1 <= self.stride <= self.size:
            raise ValueError(f"stride={self.stride} must lie in 1..size={self.size}")
        if min(self.rows, self.cols) < self.size:
            raise ValueError(
                f"slices of {self.rows}x{self.cols} are smaller than a window of "
                f"size={self.size}; choose smaller windows or a larger volume"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of windows on a slice."""
        return -(-self.rows // self.stride), -(-self.cols // self.stride)

    @property
    def padded(self) -> tuple[int, int]:
        """Rows and columns of a padded slice."""
        ny, nx = self.shape
        return self.stride * (ny - 1) + self.size, self.stride * (nx - 1) + self.size

    def pad(self, slices: Shaped[Tensor, "n rows cols k"]) -> Shaped[Tensor, "n prows pcols k"]:
        """Slices that begin at `offset` and go on around the border."""
        for dim, (extent, wide) in enumerate(
            zip((self.rows, self.cols), self.padded, strict=True), 1
        ):
            place = (torch.arange(wide, device=slices.device) + self.offset[dim - 1]) % extent
            slices = slices.index_select(dim, place)
        return slices

    def at(self, padded: Tensor, row: int, col: int) -> Tensor:
        """(n, ny, nx, ...): a view of the pixels at (row, col) of every window."""
        ny, nx = self.shape
        last = self.stride * (ny - 1) + row + 1, self.stride * (nx - 1) + col + 1
        return padded[:, row : last[0] : self.stride, col : last[1] : self.stride]

    def places(self) -> Iterator[tuple[int, int]]:
        """Every (row, column) of a window."""
        return ((i, j) for i in range(self.size) for j in range(self.size))

    def fold(self, padded: Float[Tensor, "n prows pcols k"]) -> Float[Tensor, "n rows cols k"]:
        """The adjoint of `pad`: what lies beyond the border is added where it wraps to."""
        for dim, extent in ((1, self.rows), (2, self.cols)):
            whole = padded.narrow(dim, 0, extent).clone()
            over = padded.shape[dim] - extent
            whole.narrow(dim, 0, over).add_(padded.narrow(dim, extent, over))
            padded = whole.roll(self.offset[dim - 1], dim)
        return padded

    def gather(self, slices: Float[Tensor, "n rows cols k"]) -> Float[Tensor, "m e"]:
        """The windows as rows of a matrix: slices, rows of windows, columns of windows."""
        k = slices.shape[3]
        windows = self.pad(slices).unfold(1, self.size, self.stride)
        windows = windows.unfold(2, self.size, self.stride).permute(0, 1, 2, 4, 5, 3)
        return windows.reshape(-1, self.size * self.size * k)

    def scatter(self, windows: Float[Tensor, "m e"]) -> Float[Tensor, "n rows cols k"]:
        """Sum of the windows laid back in place: the adjoint of `gather`."""
        ny, nx = self.shape
        k = windows.shape[1] // self.size**2
        parts = windows.view(-1, ny, nx, self.size, self.size, k)
        out = windows.new_zeros(len(parts), *self.padded, k)
        for i, j in self.places():  # one place at a time: no two meet in one addition
            self.at(out, i, j).add_(parts[:, :, :, i, j])
        return self.fold(out)


@dataclass(frozen=True)
class Group:
    """Slices across one axis whose windows lie at the same places.

    Args:
        axis: of the volume.
        slices: numbers of the slices.
        windows: on each of them.
    """

    axis: int
    slices: slice
    windows: Windows

    def of(self, volume: Shaped[Tensor, "d h w k"]) -> Tensor:
        """The slices of a volume with the channels last: a view (n, rows, cols, k)."""
        rows, cols = PLANES[self.axis]
        return volume.permute(self.axis, rows, cols, 3)[self.slices]


def groups(
    extent: tuple[int, int, int], axis: int, size: int, stride: int, shift: Int[Tensor, "2"]
) -> list[Group]:
    """Windows on all slices across an axis, staggered from each slice to the next.

    Neighboring slices have their windows at other places, so that every voxel is near the middle
    of some windows.

    Args:
        extent: (d, h, w) of the volume.
        shift: of all windows; drawn anew in each step, it moves the places where they end.

    Example:
        >>> [group.slices for group in groups((8, 8, 9), 2, 8, 4, torch.tensor([0, 0]))][1]
        slice(1, 9, 4)
    """
    rows, cols = (extent[other] for other in PLANES[axis])
    found = []
    for first in range(min(stride, extent[axis])):
        # a half step down with every step to the right: no two of the first four share a line
        moved = (int(shift[0]) + first * (stride // 2 + 1)) % rows
        windows = Windows(rows, cols, size, stride, (moved, (int(shift[1]) + first) % cols))
        found.append(Group(axis, slice(first, extent[axis], stride), windows))
    return found
