"""Textures put together in wavelet bands: every block's coefficients come from one place."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.image import atomic_write
from torchtex.sources import UNREADABLE, SourceField, check_maps, pixel_places, unreadable
from torchtex.wavelets import blocks_at, every_shift, reconstruct


@dataclass(frozen=True)
class BandField(SourceField):
    """A source field whose pixels are not copied: coefficients are, and the inverse blends them.

    Filters longer than Haar's reach into the neighboring blocks. Where those come from the same
    piece of the exemplar the inverse gives its pixels back. Across a seam the smooth bands of
    both sides fade into each other over as many pixels as their filters are long, and fine
    details over few. So `positions`, one per pixel, say only which block a pixel is of; `apply`
    transforms a map, copies its coefficients from there and transforms back.

    Args:
        places: exemplar, row and column of the first pixel of each block, margin included.
        wavelet: its name.
        levels: blocks have 2^levels pixels a side.
        margin: pixels cut off at each side of what the blocks make, where the filters would
            meet the far side.

    Example:
        >>> places = torch.tensor([[[0, 0, 0], [0, 0, 2]], [[0, 2, 0], [0, 2, 2]]])
        >>> band_field(places, ((4, 6),), (4, 4), "haar", 1).apply(torch.ones(1, 4, 6)).shape
        torch.Size([1, 4, 4])
    """

    places: Int[Tensor, "y x 3"]
    wavelet: str
    levels: int
    margin: int

    def apply(
        self, maps: Float[Tensor, "k hz wz"] | Sequence[Float[Tensor, "k _ _"]]
    ) -> Float[Tensor, "k h w"]:
        """Renders maps aligned with the exemplars, blended as the texture is.

        A blend may leave the range of the map a little.

        Raises:
            ValueError: another number of maps than exemplars, or a map of another size.
        """
        images = [maps] if isinstance(maps, Tensor) else list(maps)
        check_maps(images, self.shapes)
        bands = [every_shift(image, self.wavelet, self.levels) for image in images]
        whole = reconstruct(blocks_at(bands, self.places.to(images[0].device)))
        h, w = self.weights.shape[1:]
        m = self.margin
        return whole[:, m : m + h, m : m + w].contiguous()

    def save(self, path: str | Path) -> None:
        """Writes an .npz file, which `SourceField.load` reads too, as copies of pixels."""
        with atomic_write(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                sources=self.positions.cpu().to(torch.int32).numpy(),
                weights=self.weights.cpu().numpy(),
                shapes=np.array(self.shapes),
                places=self.places.cpu().to(torch.int32).numpy(),
                wavelet=np.array(self.wavelet),
                numbers=np.array([self.levels, self.margin]),
            )

    @staticmethod
    def load(path: str | Path) -> "BandField":
        """Reads a file that `save` wrote.

        Raises:
            ValueError: no such file, or another kind of file.
        """
        try:
            with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
                shapes = tuple((int(h), int(w)) for h, w in file["shapes"])
                places = torch.from_numpy(file["places"]).long()
                levels, margin = (int(n) for n in file["numbers"])
                size = file["weights"].shape[1:]
                return band_field(places, shapes, size, str(file["wavelet"]), levels, margin)
        except (*UNREADABLE, IndexError) as error:
            raise unreadable(path, error) from None


def band_field(
    places: Int[Tensor, "y x 3"],
    shapes: Sequence[tuple[int, int]],
    size: Sequence[int],
    wavelet: str,
    levels: int,
    margin: int = 0,
) -> BandField:
    """The field of blocks: see `BandField`.

    Args:
        size: (height, width) of the texture.

    Raises:
        ValueError: a block that leaves its exemplar, or too few blocks for the size.

    Example:
        >>> places = torch.zeros(2, 2, 3, dtype=torch.long)
        >>> band_field(places, ((4, 4),), (3, 4), "db2", 1).positions[0, 1, 3].tolist()
        [0, 1, 1]
    """
    positions = block_pixels(places, 2**levels)
    h, w = (int(n) for n in size)
    if min(positions.shape[0] - h, positions.shape[1] - w) < margin or margin < 0:
        raise ValueError(
            f"size={h}x{w} with margin={margin} is larger than the blocks, "
            f"{positions.shape[0]}x{positions.shape[1]}; give more blocks"
        )
    positions = positions[margin : margin + h, margin : margin + w]
    weights = torch.ones(1, h, w, device=places.device)
    return BandField(positions[None], weights, tuple(shapes), places, wavelet, levels, margin)


def block_pixels(places: Int[Tensor, "y x 3"], side: int) -> Int[Tensor, "h w 3"]:
    """Exemplar, row and column of every pixel of square blocks laid side by side.

    Args:
        places: of the first pixel of each block.
        side: of a block.

    Example:
        >>> block_pixels(torch.tensor([[[0, 5, 7]]]), 2)[..., 1].tolist()
        [[5, 5], [6, 6]]
    """
    y, x = places.shape[:2]
    inside = pixel_places((side, side), places.device)[:, None]
    pixels = places[:, None, :, None, :].repeat(1, side, 1, side, 1)
    pixels[..., 1:] += inside
    return pixels.view(y * side, x * side, 3)
