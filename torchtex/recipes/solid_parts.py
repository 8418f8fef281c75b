"""What solids are made of: exemplars, maps and masks for the axes, sizes, checked beforehand."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.inputs import check_exemplars, check_memory, check_seed, matching_masks
from torchtex.recipes.slice_models import filled
from torchtex.sources import check_maps

SolidExemplars = Float[Tensor, "c _ _"] | Sequence[Float[Tensor, "c _ _"] | None]
"""One for all axes; two: side views, and the view from above; or three: across the depth, the
rows and the columns, None where nothing is prescribed."""

SolidMaps = Float[Tensor, "k _ _"] | Sequence[Float[Tensor, "k _ _"] | None] | None
"""Further channels of each exemplar, in the same order."""

SolidMasks = Bool[Tensor, "_ _"] | Sequence[Bool[Tensor, "_ _"] | None] | None
"""True where each exemplar may be used, in the same order; None for all of one."""

OVERHEAD = 400 * 2**20
"""Bytes that the libraries and the exemplars take, about."""


@dataclass(frozen=True)
class Sides:
    """Exemplars, and which of them each axis follows.

    Args:
        exemplars: those that differ.
        maps: further channels of each, or an empty tuple.
        masks: True where each may be used, or None.
        axes: number of the exemplar for slices across the depth, the rows and the columns; None
            where nothing is prescribed.
    """

    exemplars: tuple[Tensor, ...]
    maps: tuple[Tensor, ...]
    masks: tuple[Tensor | None, ...]
    axes: tuple[int | None, int | None, int | None]

    @property
    def channels(self) -> int:
        """Of the exemplars."""
        return len(self.exemplars[0])

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """Height and width of each exemplar."""
        return tuple((z.shape[1], z.shape[2]) for z in self.exemplars)

    @property
    def images(self) -> list[Tensor]:
        """Exemplars with their maps as further channels."""
        if not self.maps:
            return list(self.exemplars)
        return [torch.cat([z, m.to(z)]) for z, m in zip(self.exemplars, self.maps, strict=True)]


def sides_of(exemplars: SolidExemplars, maps: SolidMaps = None, masks: SolidMasks = None) -> Sides:
    """Exemplars, their maps and masks checked, and told apart.

    Pixels that may not be used become like those close by, so that at a coarser scale they do
    not colour their neighbors.

    Raises:
        ValueError, TypeError: more than three, no image, other channels, or maps or masks that
            do not fit.

    Example:
        >>> sides_of([torch.ones(1, 8, 8), None, torch.zeros(1, 8, 8)]).axes
        (0, None, 1)
    """
    given = _three(exemplars)
    drawn, kept = _beside("map", maps, given), _beside("mask", masks, given)
    found: list[Tensor] = []
    layers: list[Tensor] = []
    shown: list[Tensor | None] = []
    axes: list[int | None] = []
    seen: list[tuple[int, ...]] = []
    for z, extra, mask in zip(given, drawn, kept, strict=True):
        if z is None:
            axes.append(None)
            continue
        name = (id(z), id(extra), id(mask))
        if name not in seen:
            seen.append(name)
            found.append(z)
            layers += [] if extra is None else [extra]
            shown.append(mask)
        axes.append(seen.index(name))
    return Sides(*_checked(found, layers, shown), (axes[0], axes[1], axes[2]))


def _beside(
    name: str, layers: SolidMaps | SolidMasks, given: Sequence[Tensor | None]
) -> list[Tensor | None]:
    """A map or a mask for each axis, or None."""
    if layers is None:
        return [None] * 3
    found = _three(layers, name)
    lacking = [layer is None and name == "map" for layer in found]
    for layer, absent, z in zip(found, lacking, given, strict=True):
        if (layer is not None and z is None) or (absent and z is not None):
            raise ValueError(f"{name}: give one for each exemplar, in the same order")
    return found


def _checked(
    found: Sequence[Tensor], layers: Sequence[Tensor], masks: Sequence[Tensor | None]
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...], tuple[Tensor | None, ...]]:
    """Exemplars, maps and masks that fit one another."""
    masks = matching_masks(list(masks), found)
    images = [_patched(z.detach(), mask) for z, mask in zip(found, masks, strict=True)]
    check_exemplars(images)
    if layers:
        check_maps(layers, [(z.shape[1], z.shape[2]) for z in found])
        layers = [_patched(m, mask) for m, mask in zip(layers, masks, strict=True)]
    return tuple(images), tuple(layers), tuple(masks)


def _patched(picture: Tensor, mask: Tensor | None) -> Tensor:
    """A picture whose pixels outside of the mask are copies of some that are close by."""
    if mask is None or picture.shape[1:] != mask.shape:
        return picture
    numbers = torch.arange(mask.numel(), device=picture.device).view(mask.shape)
    near = filled(torch.where(mask.to(picture.device), numbers, -1))
    return picture.flatten(1)[:, near]


def _three(given: Tensor | Sequence[Tensor | None], name: str = "exemplar") -> list[Tensor | None]:
    """One for each axis."""
    several: list[Tensor | None] = [given] if isinstance(given, Tensor) else list(given)
    if len(several) == 1:
        several = several * 3
    elif len(several) == 2:
        several = [several[0], several[1], several[0]]
    if len(several) != 3:
        raise ValueError(
            f"{name}: {len(several)} given; give one for all axes, two (from the sides, from "
            "above) or three"
        )
    if name == "exemplar" and all(z is None for z in several):
        raise ValueError("exemplar: none given; give at least one image")
    return several


def check_solid(size: Sequence[int], channels: int, least: int, seed: int) -> None:
    """Refuses a size that is too small, or that memory cannot hold, before any work.

    Raises:
        ValueError: in one sentence, what is wrong.

    Example:
        >>> check_solid((64, 4, 64), 3, 8, 0)
        Traceback (most recent call last):
        ValueError: size=64x4x64 must be at least 8x8x8 for windows of 8; ...
    """
    check_seed(seed)
    text = "x".join(str(n) for n in size)
    if len(size) != 3 or min(size) < least:
        raise ValueError(
            f"size={text} must be at least {least}x{least}x{least} for windows of {least}; "
            "give depth x rows x columns"
        )
    check_memory(text, memory_of_solid(size, channels))


def check_tiled(size: Sequence[int]) -> None:
    """Refuses a volume of tiles that memory cannot hold, before any work.

    Raises:
        ValueError: the volume and what is written of it are larger than the memory.

    Example:
        >>> check_tiled((256, 256, 256))
    """
    voxels = size[0] * size[1] * size[2]
    check_memory("x".join(str(n) for n in size), OVERHEAD + voxels * 3 * 4 * 3)


def memory_of_solid(size: Sequence[int], channels: int) -> int:
    """Bytes that making a solid takes at its peak, about.

    Example:
        >>> memory_of_solid((128, 128, 128), 3) < 3 * 2**30
        True
    """
    voxels = size[0] * size[1] * size[2]
    return OVERHEAD + voxels * (4 * 5 * (channels + 1) + 60)


def digest(picture: Tensor) -> str:
    """Shape and a few digits that tell one image from another.

    Example:
        >>> digest(torch.zeros(1, 2, 2)).split()[0]
        '1x2x2'
    """
    digits = hashlib.sha256(picture.cpu().contiguous().numpy().tobytes()).hexdigest()
    return f"{'x'.join(str(n) for n in picture.shape)} {digits[:16]}"
