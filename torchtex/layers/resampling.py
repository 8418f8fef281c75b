"""An image between its pixels: splines that pass through every pixel and blur little.

Splines keep more detail than cubic convolution or bilinear reading, because they are fitted to
all of the image first: the coefficients c solve sum over k of c(k) B(p - k) = image(p), one
division after a Fourier transform. Higher degrees keep more still, and ring beside hard edges.

Source: Unser 1999, Splines: a perfect fit for signal and image processing.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.image import check_image
from torchtex.quadratic import threads

DEGREES = (1, 3, 5, 7)


@dataclass(frozen=True)
class Spline:
    """A fitted image; called with places it gives what lies there. Made by `fit`.

    Args:
        coefficients: (c, h, w), of the B-splines in the middle of every pixel.
        degree: of the polynomials, odd.
        periodic: the image goes on as a tile; otherwise it is mirrored at its borders.
    """

    coefficients: Float[Tensor, "c h w"]
    degree: int
    periodic: bool

    def __call__(self, place: Float[Tensor, "2 n"]) -> Float[Tensor, "c n"]:
        """The image at (row, column) places. Differentiable in the places and in the image.

        Example:
            >>> fit(torch.tensor([[[1.0, 2.0, 4.0]]]))(torch.tensor([[0.0], [1.0]])).round().item()
            2.0
        """
        _, h, w = self.coefficients.shape
        rows, columns = (
            self._taps(at, count) for at, count in zip(place.double(), (h, w), strict=True)
        )
        flat = self.coefficients.flatten(1)
        total = flat.new_zeros(len(flat), place.shape[1])
        for row, down in rows:
            for column, across in columns:
                total = total + down * across * flat[:, row * w + column]
        return total

    def _taps(self, at: Tensor, count: int) -> list[tuple[Tensor, Tensor]]:
        """Indices and weights of the lines around each place."""
        corner = at.detach().floor()
        first = corner.long() - (self.degree - 1) // 2
        taps = []
        for step, weight in enumerate(basis(at - corner, self.degree)):
            if self.periodic:
                index = (first + step).remainder(count)
            else:
                index = (first + step).remainder(2 * count)
                index = torch.minimum(index, 2 * count - 1 - index)
            taps.append((index, weight.to(self.coefficients.dtype)))
        return taps


def fit(image: Float[Tensor, "c h w"], *, periodic: bool = False, degree: int = 3) -> Spline:
    """The spline through all pixels of an image.

    Args:
        periodic: the image goes on as a tile; otherwise it is mirrored at its borders.
        degree: 1 reads bilinearly, 3, 5 and 7 keep ever more detail and ring a little more.

    Raises:
        ValueError: no image, or another degree.

    Example:
        >>> image = torch.rand(3, 8, 9)
        >>> fit(image)(torch.tensor([[2.0], [7.0]]))[:, 0].sub(image[:, 2, 7]).abs().max() < 1e-5
        tensor(True)
    """
    check_image(image)
    if degree not in DEGREES:
        raise ValueError(f"degree={degree} must be one of {', '.join(map(str, DEGREES))}")
    if degree == 1:
        return Spline(image, degree, periodic)
    h, w = image.shape[1:]
    wide = image.double()
    if not periodic:
        wide = torch.cat([wide, wide.flip(1)], 1)
        wide = torch.cat([wide, wide.flip(2)], 2)
    down = _response(wide.shape[1], degree, image.device)
    across = _response(wide.shape[2], degree, image.device)[: wide.shape[2] // 2 + 1]
    with threads(1):
        spectrum = torch.fft.rfft2(wide) / (down[:, None] * across)
        coefficients = torch.fft.irfft2(spectrum, s=wide.shape[1:])
    return Spline(coefficients[:, :h, :w].to(image.dtype), degree, periodic)


def basis(t: Float[Tensor, "n"], degree: int) -> list[Float[Tensor, "n"]]:
    """Weights of the degree + 1 B-splines that reach a place t in [0, 1) past the middle one.

    Source: de Boor's recursion, for whole knots.

    Example:
        >>> [w.item() for w in basis(torch.tensor([0.5]), 1)]
        [0.5, 0.5]
    """
    weights = [torch.ones_like(t)]
    for d in range(1, degree + 1):
        none = torch.zeros_like(t)
        before, after = [none, *weights], [*weights, none]
        weights = [((t + (d - j)) * before[j] + ((j + 1) - t) * after[j]) / d for j in range(d + 1)]
    return weights


def _response(count: int, degree: int, device: torch.device) -> Tensor:
    """Fourier transform of the B-spline at the whole numbers, real since it is even."""
    weights = basis(torch.zeros(1, dtype=torch.float64, device=device), degree)[:-1]
    half = (degree - 1) // 2
    turn = 2 * torch.pi * torch.arange(count, dtype=torch.float64, device=device) / count
    total = torch.zeros_like(turn)
    for step, weight in enumerate(weights):
        total = total + weight * torch.cos(turn * (step - half))
    return total
