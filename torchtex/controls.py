"""Controls: energies beside the texture energy that steer a synthesis."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.energy import Energy
from torchtex.image import check_image, resize
from torchtex.quadratic import Quadratic, diagonal, dot


@runtime_checkable
class Scaled(Protocol):
    """A control that belongs to one image size, and can be made for another."""

    def at(self, height: int, width: int) -> Energy: ...


@dataclass(frozen=True)
class SoftConstraint:
    """sum over pixels of confidence (x - target)^2.

    Args:
        target: (c, h, w), the wished colours.
        confidence: (h, w), at least 0; 0 leaves a pixel free.

    Raises:
        ValueError: sizes that differ, or a confidence that is negative or not finite.

    Source: Kwatra et al. 2005, eq. 2.

    Example:
        >>> pull = SoftConstraint(torch.ones(3, 8, 8), torch.ones(8, 8))
        >>> pull(torch.zeros(3, 8, 8)).item()
        192.0
    """

    target: Float[Tensor, "c h w"]
    confidence: Float[Tensor, "h w"]

    def __post_init__(self) -> None:
        check_image(self.target, "target")
        if self.confidence.shape != self.target.shape[1:]:
            raise ValueError(
                f"confidence is {_size(self.confidence)} and target is {_size(self.target)}; "
                "give both the same height and width"
            )
        if not bool(torch.isfinite(self.confidence).all()) or bool((self.confidence < 0).any()):
            raise ValueError("confidence must be finite and at least 0 everywhere")

    def __call__(self, x: Float[Tensor, "c h w"]) -> Float[Tensor, ""]:
        gap = x - self.target.to(x)
        return dot(self.confidence.to(x) * gap, gap)

    def quadratic_bound(self, x: Float[Tensor, "c h w"]) -> Quadratic | None:
        return diagonal(self.confidence.to(x)[None], self.target.to(x))

    def at(self, height: int, width: int) -> "SoftConstraint":
        """The same constraint on an image of another size; free pixels do not bleed in."""
        held = self.confidence[None]
        small = resize(held, (height, width)).clamp(min=0)
        target = resize(self.target * (held > 0), (height, width))
        share = resize((held > 0).to(held), (height, width))
        free = share < 0.05
        target = (target / share.clamp(min=0.05)).clamp(0, 1)
        return replace(self, target=target, confidence=small[0].masked_fill(free[0], 0))


@dataclass(frozen=True)
class Guide:
    """Fixed channels of exemplar and texture that neighborhoods should agree in.

    Args:
        exemplars: one (g, hz, wz) image per exemplar, aligned with it.
        texture: (g, h, w), aligned with the texture.
        weight: of the squared distance between guides, against 1 for the feature.

    Source: Hertzmann et al. 2001, and Kwatra et al. 2005, section 4 (general controls).

    Example:
        >>> Guide([torch.zeros(1, 16, 16)], torch.zeros(1, 32, 32)).weight
        1.0
    """

    exemplars: Sequence[Float[Tensor, "g _ _"]]
    texture: Float[Tensor, "g h w"]
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_image(self.texture, "guide")
        for image in self.exemplars:
            check_image(image, "guide")
            if len(image) != len(self.texture):
                raise ValueError(
                    f"guide of the exemplar has {len(image)} channels and that of the texture "
                    f"{len(self.texture)}; give both the same number"
                )
        if not self.weight >= 0:
            raise ValueError(f"weight={self.weight} of a guide must be at least 0")

    def at(self, scale: float, height: int, width: int) -> "Guide":
        """The same guide for exemplars scaled by `scale` and a texture of the given size."""
        smaller = [
            resize(z, (max(1, round(z.shape[1] * scale)), max(1, round(z.shape[2] * scale))))
            for z in self.exemplars
        ]
        return replace(self, exemplars=smaller, texture=resize(self.texture, (height, width)))


def _size(image: Tensor) -> str:
    return f"{image.shape[-2]}x{image.shape[-1]}"
