"""Neighborhoods: square windows of an image, their Gaussian fall-off, and the exact adjoint."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor


@runtime_checkable
class Neighborhoods(Protocol):
    """Windows of an image as vectors; `scatter` is the exact adjoint of `gather`."""

    def gather(self, image: Float[Tensor, "k *space"]) -> Float[Tensor, "n d"]: ...

    def scatter(self, patches: Float[Tensor, "n d"]) -> Float[Tensor, "k *space"]: ...


def site_positions(extent: int, size: int, stride: int, periodic: bool = False) -> Int[Tensor, "n"]:
    """First pixels of windows along one axis: at most `stride` apart, first to last pixel covered.

    The spacing is spread evenly (it may be smaller than `stride`), so that any extent is tiled
    and a periodic axis has no narrower gap where it wraps.

    Example:
        >>> site_positions(20, 8, 5).tolist()
        [0, 4, 8, 12]
    """
    if periodic:
        count = -(-extent // stride)
        return torch.arange(count) * extent // count
    count = -(-(extent - size) // stride)
    return torch.arange(count + 1) * (extent - size) // max(count, 1)


@dataclass(frozen=True)
class Grid:
    """Windows of `size` x `size` pixels, at most `stride` apart, on a height x width image.

    Every pixel lies in at least one window, so a weighted average never divides by zero.
    With `periodic` the windows wrap around both borders, and no border is special.
    A vector of a window lists rows, then columns, then channels.

    Raises:
        ValueError: `stride` outside 1..size, or an extent smaller than `size`.

    Source: Kwatra et al. 2005, section 3, the subsampled set of sites X-dagger.

    Example:
        >>> grid = Grid(24, 20, 8, 4)
        >>> grid.gather(torch.zeros(3, 24, 20)).shape
        torch.Size([20, 192])
    """

    height: int
    width: int
    size: int
    stride: int
    periodic: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.stride <= self.size:
            raise ValueError(f"stride={self.stride} must lie in 1..size={self.size}")
        for name, extent in (("height", self.height), ("width", self.width)):
            if extent < self.size:
                raise ValueError(
                    f"{name}={extent} is smaller than a window of size={self.size}; "
                    "choose smaller windows or a larger image"
                )

    @property
    def rows(self) -> Int[Tensor, "ny"]:
        """Top row of each row of windows."""
        return site_positions(self.height, self.size, self.stride, self.periodic)

    @property
    def cols(self) -> Int[Tensor, "nx"]:
        """Left column of each column of windows."""
        return site_positions(self.width, self.size, self.stride, self.periodic)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of sites."""
        return len(self.rows), len(self.cols)

    def __len__(self) -> int:
        return self.shape[0] * self.shape[1]

    @property
    def sites(self) -> Int[Tensor, "n 2"]:
        """(row, column) of the first pixel of each window, in the order of `gather`."""
        return torch.cartesian_prod(self.rows, self.cols).reshape(-1, 2)

    def bands(self, most: int) -> list[slice]:
        """Slices of site rows that hold at most about `most` windows each, to bound memory."""
        ny, nx = self.shape
        step = max(1, most // nx)
        return [slice(start, min(start + step, ny)) for start in range(0, ny, step)]

    def gather(
        self, image: Float[Tensor, "k h w"], band: slice = slice(None)
    ) -> Float[Tensor, "n d"]:
        """Windows as rows of a matrix; `band` picks some rows of sites."""
        k = image.shape[0]
        rows = _spans(self.rows[band], self.size, self.height).to(image.device)
        cols = _spans(self.cols, self.size, self.width).to(image.device)
        first, last = int(rows.min()), int(rows.max()) + 1
        rows = rows - first
        strips = image[:, first:last].permute(1, 2, 0)[:, cols.flatten()]  # rows, nx * size, k
        strips = strips.reshape(last - first, len(cols), self.size * k)
        windows = strips[rows.flatten()].view(len(rows), self.size, len(cols), self.size * k)
        return windows.transpose(1, 2).reshape(-1, self.size * self.size * k)

    def scatter(
        self,
        patches: Float[Tensor, "n d"],
        band: slice = slice(None),
        *,
        out: Float[Tensor, "k h w"] | None = None,
    ) -> Float[Tensor, "k h w"]:
        """Sum of the windows laid back in place: the adjoint of `gather`.

        Args:
            patches: windows of the site rows of `band`.
            out: an image to add to in place; zeros unless given.
        """
        rows, cols = self.rows[band], self.cols
        k = patches.shape[1] // self.size**2
        windows = patches.view(len(rows), len(cols), self.size, self.size, k)
        # positions within one offset are distinct, so the sums have one order on any device
        wide = patches.new_zeros(len(rows), self.width, self.size, k)
        col_spans = _spans(cols, self.size, self.width).to(patches.device)
        for offset in range(self.size):
            wide.index_add_(1, col_spans[:, offset], windows[:, :, :, offset])
        image = self.zeros(patches, k) if out is None else out
        row_spans = _spans(rows, self.size, self.height).to(patches.device)
        for offset in range(self.size):
            image.permute(1, 2, 0).index_add_(0, row_spans[:, offset], wide[:, :, offset])
        return image.contiguous() if out is None else out

    def zeros(self, like: Float[Tensor, "..."], k: int) -> Float[Tensor, "k h w"]:
        """A black image in the memory order that `scatter` adds to fastest."""
        return like.new_zeros(self.height, self.width, k).permute(2, 0, 1)


def _spans(starts: Tensor, size: int, extent: int) -> Tensor:
    return (starts[:, None] + torch.arange(size)) % extent


def falloff(size: int, *, sigma: float | None = None) -> Float[Tensor, "size size"]:
    """Gaussian weight of each pixel of a window; its mean is 1. float64.

    Pixels near the centre count more than those far away. `sigma` is in pixels and a third of
    `size` unless given.

    Source: Kwatra et al. 2005, end of section 3.1.

    Example:
        >>> falloff(8).shape
        torch.Size([8, 8])
    """
    place = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    profile = torch.exp(-0.5 * (place / (sigma or size / 3)) ** 2)
    weights = torch.outer(profile, profile)
    return weights / weights.mean()
