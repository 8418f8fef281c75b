"""Blocks of a skeletal synthesis: where they may come from, and what their coarse pixels are."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Int
from torch import Tensor

from torchtex.bands import band_field, block_pixels
from torchtex.inputs import check_size, memory_of
from torchtex.label_spaces import LabelSpace, label_space
from torchtex.sources import SourceField, copied, pixel_places
from torchtex.wavelets import every_shift, reach

LEAST = 6
"""Side of the smallest windows of the coarse band."""


@dataclass(frozen=True)
class BlockShape:
    """Blocks, phases and margins of a skeletal synthesis.

    Args:
        size: (height, width) of the texture.
        levels: blocks have 2^levels pixels a side.
        wavelet, phases, boundary: see `skeleton`.

    Example:
        >>> BlockShape((50, 64), 1, "haar", 1, "free").blocks
        (25, 32)
    """

    size: tuple[int, int]
    levels: int
    wavelet: str
    phases: int
    boundary: str

    @property
    def side(self) -> int:
        """Pixels of a block along each axis."""
        return 2**self.levels

    @property
    def margin(self) -> int:
        """Blocks at each side that a free border needs, so that no filter meets the far side."""
        if self.boundary == "periodic":
            return 0
        return -(-(max(reach(self.wavelet, self.levels)) - self.side + 1) // self.side)

    @property
    def blocks(self) -> tuple[int, int]:
        """Rows and columns of blocks, margin included."""
        rows, cols = (-(-n // self.side) + 2 * self.margin for n in self.size)
        return rows, cols

    def check(self, zs: Sequence[Tensor]) -> None:
        """Refuses what cannot be done."""
        height, width = self.size
        if not 1 <= self.levels <= 8:
            raise ValueError(f"levels={self.levels} must lie in 1..8")
        reach(self.wavelet, self.levels)  # refuses an unknown wavelet
        if self.boundary not in ("free", "periodic"):
            raise ValueError(f'boundary="{self.boundary}" must be "free" or "periodic"')
        check_size(self.size, memory_of(zs[0], self.size, images=8, numbers=24))
        side, phases = self.side, self.phases
        if not (1 <= phases <= side and phases & (phases - 1) == 0):
            raise ValueError(f"phases={phases} must be a power of 2, at most 2^levels={side}")
        if self.boundary == "periodic" and (height % side or width % side):
            near = "x".join(str(max(1, round(n / side)) * side) for n in self.size)
            raise ValueError(
                f"size={height}x{width} with a periodic boundary must be a multiple of "
                f"2^levels={side}; choose {near}, or fewer levels"
            )
        for what, h, w in (("exemplar", *_largest(zs)), ("size", height, width)):
            if min(h, w) < LEAST * side:
                raise ValueError(
                    f"levels={self.levels} is too many for {what}={h}x{w}, which must be at least "
                    f"{LEAST * side} pixels a side for windows of the coarse band; "
                    f"choose fewer levels or a larger {what}"
                )

    def places(self, zs: Sequence[Tensor], keep: Sequence[Tensor | None]) -> LabelSpace:
        """Every place of a block whose coefficients see only pixels that may be used."""
        before, after = reach(self.wavelet, self.levels)
        around = max(before, after - self.side + 1)
        clear = [None if mask is None else _eroded(mask, around) for mask in keep]
        shapes = [(z.shape[1], z.shape[2]) for z in zs]
        space = label_space(shapes, self.side, clear, device=zs[0].device)
        if not len(space):
            raise ValueError(
                f"levels={self.levels}: no block of {self.side} pixels fits into the masks; "
                "choose fewer levels or wider masks"
            )
        return space

    def coarse(self, z: Tensor) -> Tensor:
        """The approximation at every shift, in the range of the image."""
        return every_shift(z, self.wavelet, self.levels).approximation / self.side

    def exemplars(
        self, coarse: Sequence[Tensor], space: LabelSpace
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """Coarse exemplars, which of their pixels may be used, and exemplar and shift of each."""
        side, step = self.side, self.side // self.phases
        pictures, usable, corners = [], [], []
        for number, (band, table) in enumerate(zip(coarse, space.tables, strict=True)):
            h, w = (n - side + 1 for n in band.shape[1:])
            for i in range(0, side, step):
                for j in range(0, side, step):
                    picture = band[:, i:h:side, j:w:side].contiguous()
                    mask = (table[i:h:side, j:w:side] >= 0).to(band.device)
                    if picture.numel() and bool(mask.any()):
                        pictures.append(picture)
                        usable.append(mask)
                        corners.append((number, i, j))
        if not pictures:
            raise ValueError(
                f"levels={self.levels}: the masks leave no block of {self.side} pixels whole; "
                "choose fewer levels, more phases or wider masks"
            )
        return pictures, usable, torch.tensor(corners, device=coarse[0].device)

    def origins(self, sources: Int[Tensor, "y x 3"], corners: Tensor) -> Int[Tensor, "y x 3"]:
        """Where the block of each coarse pixel is from."""
        places = corners.to(sources.device)[sources[..., 0]]
        places[..., 1:] += sources[..., 1:] * self.side
        return places

    def split(self, places: Int[Tensor, "y x 3"]) -> Int[Tensor, "2*y 2*x 3"]:
        """Where the four quarters of each block are from."""
        inside = pixel_places((2, 2), places.device)[:, None] * (self.side // 2)
        quarters = places[:, None, :, None].repeat(1, 2, 1, 2, 1)
        quarters[..., 1:] += inside
        return quarters.view(2 * places.shape[0], 2 * places.shape[1], 3)

    def sources(self, places: Int[Tensor, "y x 3"], corners: Tensor) -> Int[Tensor, "y x 3"]:
        """Coarse exemplar, row and column of the pixel of each block: undoes `origins`."""
        numbers = torch.zeros(int(corners[:, 0].max()) + 1, self.side, self.side).long()
        numbers = numbers.to(places.device)
        numbers[corners.unbind(1)] = torch.arange(len(corners), device=places.device)
        which, row, col = places.unbind(-1)
        which = numbers[which, row % self.side, col % self.side]
        return torch.stack([which, row // self.side, col // self.side], -1)

    def copies(
        self, places: Int[Tensor, "y x 3"], zs: Sequence[Tensor], margin: int
    ) -> SourceField:
        """Every pixel copied with its block.

        Args:
            margin: pixels at each side that are cut off.
        """
        (h, w), shapes = self.size, [(z.shape[1], z.shape[2]) for z in zs]
        pixels = block_pixels(places, self.side)[margin : margin + h, margin : margin + w]
        return copied(pixels.contiguous(), shapes)

    def field(self, places: Int[Tensor, "y x 3"], zs: Sequence[Tensor], margin: int) -> SourceField:
        """As `copies`, but a wavelet longer than Haar's copies coefficients, which are blended."""
        if self.wavelet == "haar":
            return self.copies(places, zs, margin)
        shapes = [(z.shape[1], z.shape[2]) for z in zs]
        return band_field(places, shapes, self.size, self.wavelet, self.levels, margin)


def _largest(zs: Sequence[Tensor]) -> tuple[int, int]:
    h, w = max((z.shape[1:] for z in zs), key=min)
    return h, w


def _eroded(mask: Tensor, around: int) -> Tensor:
    """True where all pixels so far around, inside the image, are."""
    if around <= 0:
        return mask
    bad = F.max_pool2d((~mask)[None].float(), 2 * around + 1, 1, around)[0]
    return bad == 0
