"""What solids are made of: exemplars and maps for the axes, sizes, checked before any work."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.inputs import check_exemplars, check_seed, check_size
from torchtex.sources import check_maps

SolidExemplars = Float[Tensor, "c _ _"] | Sequence[Float[Tensor, "c _ _"] | None]
"""One for all axes; two: side views, and the view from above; or three: across the depth, the
rows and the columns, None where nothing is prescribed."""

SolidMaps = Float[Tensor, "k _ _"] | Sequence[Float[Tensor, "k _ _"] | None] | None
"""Further channels of each exemplar, in the same order."""

OVERHEAD = 400 * 2**20
"""Bytes that the libraries and the exemplars take, about."""


@dataclass(frozen=True)
class Sides:
    """Exemplars, and which of them each axis follows.

    Args:
        exemplars: those that differ.
        maps: further channels of each, or an empty tuple.
        axes: number of the exemplar for slices across the depth, the rows and the columns; None
            where nothing is prescribed.
    """

    exemplars: tuple[Tensor, ...]
    maps: tuple[Tensor, ...]
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


def sides_of(exemplars: SolidExemplars, maps: SolidMaps = None) -> Sides:
    """Exemplars and their maps checked, and told apart.

    Raises:
        ValueError, TypeError: more than three, no image, other channels, or maps that do not fit.

    Example:
        >>> sides_of([torch.ones(1, 8, 8), None, torch.zeros(1, 8, 8)]).axes
        (0, None, 1)
    """
    given = _three(exemplars)
    held = [z for z in given if z is not None]
    check_exemplars(held)
    drawn = None if maps is None else _three(maps)
    if drawn is not None:
        if [m is None for m in drawn] != [z is None for z in given]:
            raise ValueError("map: give one for each exemplar, in the same order")
        shapes = [(z.shape[1], z.shape[2]) for z in held]
        check_maps([m for m in drawn if m is not None], shapes)
    found: list[Tensor] = []
    layers: list[Tensor] = []
    axes: list[int | None] = []
    for number, z in enumerate(given):
        if z is None:
            axes.append(None)
            continue
        extra = None if drawn is None else drawn[number]
        same = [
            n
            for n, other in enumerate(found)
            if other is z and (extra is None or layers[n] is extra)
        ]
        if not same:
            found.append(z)
            layers += [] if extra is None else [extra]
        axes.append(same[0] if same else len(found) - 1)
    return Sides(tuple(z.detach() for z in found), tuple(layers), (axes[0], axes[1], axes[2]))


def _three(given: Tensor | Sequence[Tensor | None]) -> list[Tensor | None]:
    """One for each axis."""
    several: list[Tensor | None] = [given] if isinstance(given, Tensor) else list(given)
    if len(several) == 1:
        several = several * 3
    elif len(several) == 2:
        several = [several[0], several[1], several[0]]
    if len(several) != 3:
        raise ValueError(
            f"exemplar: {len(several)} given; give one for all axes, two (from the sides, from "
            "above) or three"
        )
    if all(z is None for z in several):
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
    try:
        check_size((1, 1), memory_of_solid(size, channels))
    except ValueError as error:
        raise ValueError(str(error).replace("size=1x1", f"size={text}")) from None


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
