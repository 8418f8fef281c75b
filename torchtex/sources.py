"""The source field: where every pixel of a montage came from, and how to render from it."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.image import atomic_write, check_image

UNREADABLE = (
    OSError, KeyError, ValueError, TypeError, AttributeError, EOFError, BadZipFile, zlib.error,
)  # fmt: skip
"""What numpy raises for files that are no label files."""


@dataclass(frozen=True)
class SourceField:
    """Source of every pixel of a texture: exemplar, row and column.

    Most recipes have one layer, a copy; feathered ones blend several.

    Args:
        positions: (layers, h, w, 3). Whole numbers copy a pixel; fractional rows and columns,
            of rotated or scaled patches, are read bilinearly.
        weights: (layers, h, w), of the layers; they need not add up to 1.
        shapes: height and width of each exemplar.

    Raises:
        ValueError: a position outside its exemplar.

    Example:
        >>> field = copied(torch.tensor([[[0, 1, 2], [0, 3, 0]]]), ((4, 4),))
        >>> field.apply(torch.arange(16.0).view(1, 4, 4)).tolist()
        [[[6.0, 12.0]]]
    """

    positions: Tensor
    weights: Float[Tensor, "layers h w"]
    shapes: tuple[tuple[int, int], ...]

    def __post_init__(self) -> None:
        if self.positions.shape != (*self.weights.shape, 3):
            raise ValueError(
                f"positions of {tuple(self.positions.shape)} do not fit weights of "
                f"{tuple(self.weights.shape)}; give (layers, h, w, 3) and (layers, h, w)"
            )
        which = self.positions[..., 0].long()
        if int(which.min()) < 0 or int(which.max()) >= len(self.shapes):
            raise ValueError("positions name an exemplar that is not in shapes")
        room = torch.tensor(self.shapes, device=which.device)[which] - 1
        place = self.positions[..., 1:]
        if bool((place < 0).any()) or bool((place > room).any()):
            raise ValueError("positions leave their exemplar")

    def source_map(self) -> Int[Tensor, "h w 3"]:
        """Exemplar, row and column that weigh most in each pixel, rounded."""
        best = self.weights.argmax(0)
        return (
            self.positions.gather(0, best[None, ..., None].expand(1, -1, -1, 3))[0].round().long()
        )

    def apply(
        self, maps: Float[Tensor, "k hz wz"] | Sequence[Float[Tensor, "k _ _"]]
    ) -> Float[Tensor, "k h w"]:
        """Renders maps aligned with the exemplars (normals, height, ...) from the same sources.

        Raises:
            ValueError: another number of maps than exemplars, or a map of another size.
        """
        images = [maps] if isinstance(maps, Tensor) else list(maps)
        check_maps(images, self.shapes)
        whole = images[0].new_zeros(len(images[0]), *self.weights.shape[1:])
        total = self.weights.sum(0).to(whole)
        for positions, weights in zip(self.positions, self.weights, strict=True):
            share = weights.to(whole)
            for number, image in enumerate(images):
                here = positions[..., 0] == number
                whole[:, here] += share[here] * _read(image, positions[here][:, 1:])
        return whole if len(self.weights) == 1 and bool((total == 1).all()) else whole / total

    def save(self, path: str | Path) -> None:
        """Writes an .npz file.

        Raises:
            ValueError: the file cannot be written.
        """
        positions = self.positions.cpu()
        kind = torch.float32 if positions.is_floating_point() else torch.int32
        with atomic_write(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                sources=positions.to(kind).numpy(),
                weights=self.weights.cpu().numpy(),
                shapes=np.array(self.shapes),
            )

    @staticmethod
    def load(path: str | Path) -> "SourceField":
        """Reads a file that `save` wrote.

        Raises:
            ValueError: no such file, or another kind of file.
        """
        try:
            with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
                positions = torch.from_numpy(file["sources"])
                weights = torch.from_numpy(file["weights"])
                shapes = tuple((int(h), int(w)) for h, w in file["shapes"])
            if not positions.is_floating_point():
                positions = positions.long()
            return SourceField(positions, weights, shapes)
        except UNREADABLE as error:
            raise unreadable(path, error) from None


def pixel_places(size: Sequence[int], device: torch.device | None = None) -> Int[Tensor, "h w 2"]:
    """Row and column of every pixel of an image of that size.

    Example:
        >>> pixel_places((1, 3)).tolist()
        [[[0, 0], [0, 1], [0, 2]]]
    """
    lines = (torch.arange(extent, device=device) for extent in size)
    return torch.stack(torch.meshgrid(*lines, indexing="ij"), -1)


def copied(positions: Tensor, shapes: Sequence[tuple[int, int]]) -> SourceField:
    """A field that copies every pixel from one place.

    Args:
        positions: (h, w, 3), exemplar, row and column.
        shapes: height and width of each exemplar.

    Example:
        >>> copied(torch.zeros(2, 3, 3, dtype=torch.long), ((8, 8),)).weights.shape
        torch.Size([1, 2, 3])
    """
    weights = torch.ones(1, *positions.shape[:2], device=positions.device)
    return SourceField(positions[None], weights, tuple(shapes))


def check_maps(images: Sequence[Float[Tensor, "k _ _"]], shapes: Sequence[tuple[int, int]]) -> None:
    """Refuses maps that are not aligned with the exemplars.

    Raises:
        ValueError: another number of maps than exemplars, or a map of another size.

    Example:
        >>> check_maps([torch.zeros(1, 4, 4)], [(4, 4)])
    """
    if len(images) != len(shapes):
        raise ValueError(f"map: {len(images)} given for {len(shapes)} exemplars; give one each")
    for image, (height, width) in zip(images, shapes, strict=True):
        check_image(image, "map")
        if tuple(image.shape[1:]) != (height, width):
            raise ValueError(
                f"map is {image.shape[1]}x{image.shape[2]} and its exemplar is "
                f"{height}x{width}; give a map of the size of the exemplar"
            )
        if len(image) != len(images[0]):
            raise ValueError(
                f"map: one has {len(images[0])} channels and another {len(image)}; "
                "give all the same"
            )


def unreadable(path: str | Path, error: Exception) -> ValueError:
    """The error for a file that is no label file.

    Example:
        >>> raise unreadable("x.npz", ValueError("empty"))
        Traceback (most recent call last):
        ValueError: ...
    """
    return ValueError(
        f"labels={path} is not a label file ({error}); give an .npz written with --labels or save"
    )


def _read(image: Tensor, places: Tensor) -> Tensor:
    """(k, n): pixels at (row, column), between pixels when they are fractional."""
    if not places.is_floating_point():
        return image[:, places[:, 0], places[:, 1]]
    limit = torch.tensor(image.shape[1:], device=places.device) - 1
    low = places.floor().long()
    high = torch.minimum(low + 1, limit)
    down, right = (places - low).to(image).T
    top = torch.lerp(image[:, low[:, 0], low[:, 1]], image[:, low[:, 0], high[:, 1]], right)
    bottom = torch.lerp(image[:, high[:, 0], low[:, 1]], image[:, high[:, 0], high[:, 1]], right)
    return torch.lerp(top, bottom, down)
