"""Features: what is compared when two neighborhoods are compared."""

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex import wavelets


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
    """A feature that may have a second, linear stage inside each window."""

    @property
    def windowed(self) -> bool: ...

    def window(self, patches: Float[Tensor, "n size size k"]) -> Float[Tensor, "n size size k"]: ...


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


@dataclass(frozen=True)
class Wavelets:
    """Wavelet coefficients, each band with a weight.

    "stationary": the undecimated transform of the whole image. A coefficient near the border of
    a window sees pixels beyond it, so this differs from the pixel distance.
    "window": the decimated transform of each window. It is orthonormal, so with equal weights
    it is the pixel distance under another name, fall-off included; it differs by its weights.

    Args:
        wavelet: "haar", "db2" ... "db8", or another orthogonal wavelet of PyWavelets.
        mode: see above.
        levels: how often the scale is doubled.
        weights: of the squared coefficients: the approximation, then one per level, the coarsest
            first; 0 drops a band. None for 1 and `detail` on every level.
        detail: weight of the details when `weights` is None.

    Raises:
        ValueError: an unknown wavelet, a level below 1, another number of weights.

    Source: Shen et al. 2010, section 3.3; Pan et al. 2009, section 4.

    Example:
        >>> Wavelets("db2")(torch.zeros(3, 16, 16)).shape
        torch.Size([21, 16, 16])
    """

    wavelet: str = "haar"
    mode: Literal["stationary", "window"] = "stationary"
    levels: int = 2
    weights: tuple[float, ...] | None = None
    detail: float = 4.0
    linear: bool = True

    def __post_init__(self) -> None:
        wavelets.filters(self.wavelet)
        if self.mode not in ("stationary", "window"):
            raise ValueError(f'mode="{self.mode}" must be "stationary" or "window"')
        if not 1 <= self.levels <= 8:
            raise ValueError(f"levels={self.levels} must lie in 1..8")
        if not self.detail >= 0:
            raise ValueError(f"detail={self.detail} must be at least 0")
        if len(self.level_weights) != self.levels + 1 or min(self.level_weights) < 0:
            raise ValueError(
                f"weights={self.weights} must be {self.levels + 1} numbers of at least 0: "
                "the approximation and one per level"
            )

    @property
    def level_weights(self) -> tuple[float, ...]:
        """Weight of the approximation, and of the details of each level, the coarsest first."""
        return (1.0, *(self.detail,) * self.levels) if self.weights is None else self.weights

    @property
    def windowed(self) -> bool:
        """True when the transform is inside the windows."""
        return self.mode == "window"

    @property
    def _roots(self) -> list[float]:
        first, *rest = self.level_weights
        return [first**0.5, *(w**0.5 for w in rest for _ in range(3))]

    def __call__(self, image: Float[Tensor, "c h w"]) -> Float[Tensor, "k h w"]:
        if self.mode == "window":
            return image
        bands = wavelets.stationary(image, self.wavelet, self.levels)
        roots = torch.tensor(self._roots).to(image)[:, None, None, None]
        return (bands * roots).flatten(0, 1)

    def window(self, patches: Float[Tensor, "n size size k"]) -> Float[Tensor, "n size size k"]:
        """The transform inside each window, for the mode "window"."""
        size = patches.shape[1]
        levels = max(1, min(self.levels, (size & -size).bit_length() - 1))
        whole = wavelets.window_transform(patches, self.wavelet, levels)
        kinds = wavelets.window_bands(size, levels).to(patches.device)
        # a small window cannot be halved so often: its coarsest levels are missing
        some = [self._roots[0], *self._roots[len(self._roots) - 3 * levels :]]
        roots = torch.tensor(some).to(patches)[kinds]
        return whole * roots[..., None]


@dataclass(frozen=True)
class Stack:
    """Several features side by side: their squared distances add up, each with a weight.

    Raises:
        ValueError: no feature, another number of weights, or a feature with a stage inside
            windows (`Wavelets(mode="window")`), which sees windows and not the image.

    Example:
        >>> Stack((Pixels(), Gradients()), (1.0, 0.5))(torch.ones(1, 8, 8)).shape
        torch.Size([4, 8, 8])
    """

    features: tuple[Feature, ...]
    weights: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        weights = self.weights
        if not self.features:
            raise ValueError("features of a stack: none given; give at least one")
        if weights is not None and (len(weights) != len(self.features) or min(weights) < 0):
            raise ValueError(
                f"weights={weights} must be {len(self.features)} numbers of at least 0"
            )
        if any(as_windowed(f) is not None for f in self.features):
            raise ValueError('Wavelets(mode="window") cannot be stacked; use mode="stationary"')

    @property
    def linear(self) -> bool:
        """True when every feature is linear."""
        return all(is_linear(f) for f in self.features)

    def __call__(self, image: Float[Tensor, "c h w"]) -> Float[Tensor, "k h w"]:
        weights = self.weights or (1.0,) * len(self.features)
        pairs = zip(self.features, weights, strict=True)
        return torch.cat([weight**0.5 * feature(image) for feature, weight in pairs])


def is_linear(feature: Feature) -> bool:
    """True for a feature that says it is a linear map.

    Example:
        >>> is_linear(Pixels()), is_linear(torch.sqrt)
        (True, False)
    """
    return isinstance(feature, Linear) and feature.linear


def as_windowed(feature: Feature) -> Windowed | None:
    """The feature, if it has a stage inside windows.

    Example:
        >>> as_windowed(Wavelets("haar")) is None
        True
    """
    return feature if isinstance(feature, Windowed) and feature.windowed else None
