"""Features: what is compared when two neighborhoods are compared."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor




@runtime_checkable
class Feature(Protocol):
    """A map from an image to channels of the same size; any differentiable callable will do."""

    def __call__(self, image: Float[Tensor, "c h w"]) -> Float[Tensor, "k h w"]: ...


@runtime_checkable
class Linear(Protocol):
    """A feature that is a linear map; its adjoint comes from autograd."""

    linear: bool


@runtime_checkable
class Windowed(Protocol):
    """A feature with a second, linear stage inside each window."""

    def window(
        self, patches: Float[Tensor, "n size size k"]
    ) -> Float[Tensor, "n size size k"]: ...


@dataclass(frozen=True)
class Pixels:
    """The colours themselves.

    Example:
        >>> Pixels()(torch.ones(3, 4, 5)).shape
        torch.Size([3, 4, 5])
    """

    linear: bool = True

    def __call__(self, image: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        return image


@dataclass(frozen=True)
class Gradients:
    """Colours, and forward differences with the weight `mu`: |x|^2 + mu |Dx|^2.

    Source: Kwatra et al. 2005, section 3, "Gradient-based Energy"; mu = 10 there.

    Example:
        >>> Gradients()(torch.ones(3, 4, 5)).shape
        torch.Size([9, 4, 5])
    """

    mu: float = 10.0
    linear: bool = True

    def __post_init__(self) -> None:
        if not self.mu >= 0:
            raise ValueError(f"mu={self.mu} must be at least 0")

    def __call__(self, image: Float[Tensor, "c h w"]) -> Float[Tensor, "k h w"]:
        down, right = torch.zeros_like(image), torch.zeros_like(image)
        down[:, :-1] = image[:, 1:] - image[:, :-1]
        right[:, :, :-1] = image[:, :, 1:] - image[:, :, :-1]
        return torch.cat([image, self.mu**0.5 * down, self.mu**0.5 * right])
