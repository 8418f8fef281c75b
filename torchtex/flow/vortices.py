"""Whirls by a formula: vortices that add up, on a plane or a torus."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.flow.fields import MIDDLE, check_numbers, check_positive, from_center, traced
from torchtex.flow.warps import sample
from torchtex.quadratic import threads

_PEAK = 0.6381726863389515  # largest value of (1 - exp(-s^2)) / s


@dataclass(frozen=True)
class Vortices:
    """Whirls that add up; two of opposite strength are a pair with a jet between them.

    The speed around each is proportional to (1 - exp(-s^2)) / s, s = distance / radius.

    Args:
        strengths: fastest speed of each, pixels per frame; positive turns counter-clockwise.
        centers: (row, column) of each, shares of height and width.
        radius: of the core, a share of the shorter side.
        periodic: every vortex stands in each copy of the tile. The mean vorticity of a torus is
            0, so the rest of the tile turns against them.

    Raises:
        ValueError: other numbers of centers than of strengths, or a radius of 0 or less.

    Source: Lamb-Oseen vortex; its vorticity is a Gaussian, whose Fourier series is known.

    Example:
        >>> Vortices((3.0,))(0, 9, 9)[:, 4, 4].abs().tolist()  # the middle stands still
        [0.0, 0.0]
    """

    strengths: tuple[float, ...] = (3.0,)
    centers: tuple[tuple[float, float], ...] = (MIDDLE,)
    radius: float = 0.2
    periodic: bool = False

    def __post_init__(self) -> None:
        check_numbers({"strengths": self.strengths})
        for center in self.centers:
            check_numbers({"centers": center})
        check_positive({"radius": self.radius})
        if not self.strengths or len(self.strengths) != len(self.centers):
            raise ValueError(
                f"strengths={self.strengths} are {len(self.strengths)} numbers for "
                f"{len(self.centers)} centers; give one for each, and at least one"
            )

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        core = self.radius * min(height, width)
        each = list(zip(self.strengths, self.centers, strict=True))
        here = from_center((0.0, 0.0), height, width)
        if self.periodic:
            with threads(1):  # Fourier transforms
                tiles = [s * _torus_vortex(center, core, height, width) for s, center in each]
            tile = sum(tiles[1:], tiles[0])
            return traced(lambda place: sample(tile, place - 0.5, periodic=True), here)

        def velocity(place: Tensor) -> Tensor:
            total = torch.zeros_like(place)
            for strength, (row, column) in each:
                middle = torch.tensor([row * height, column * width], dtype=torch.float64)
                total = total + strength * _vortex(place - middle[:, None, None], core)
            return total

        return traced(velocity, here)


def vortex_pair(
    strength: float = 3.0, radius: float = 0.12, distance: float = 0.4, periodic: bool = False
) -> Vortices:
    """Two vortices side by side that turn against each other: the jet between them goes up
    (down if `strength` is negative), and is faster than either.

    Args:
        strength, radius, periodic: as in `Vortices`.
        distance: between the centres, a share of the width.

    Example:
        >>> vortex_pair().strengths
        (3.0, -3.0)
    """
    check_numbers({"distance": distance})
    centers = ((0.5, 0.5 - distance / 2), (0.5, 0.5 + distance / 2))
    return Vortices((strength, -strength), centers, radius, periodic)


def _vortex(offset: Float[Tensor, "2 h w"], core: float) -> Float[Tensor, "2 h w"]:
    row, column = offset
    s = (row.square() + column.square()) / core**2
    # (1 - exp(-s)) / s, which is 1 in the middle
    spin = -torch.expm1(-s) / s.clamp(min=1e-12) / (_PEAK * core)
    spin = torch.where(s > 1e-12, spin, 1 / (_PEAK * core))
    return torch.stack([-column * spin, row * spin])


def _torus_vortex(
    center: tuple[float, float], core: float, height: int, width: int
) -> Float[Tensor, "2 h w"]:
    ky = 2 * math.pi * torch.fft.fftfreq(height, dtype=torch.float64)[:, None]
    kx = 2 * math.pi * torch.fft.fftfreq(width, dtype=torch.float64)[None]
    k2 = ky.square() + kx.square()
    circulation = 2 * math.pi * core / _PEAK
    phase = ky * (center[0] * height - 0.5) + kx * (center[1] * width - 0.5)
    vorticity = torch.polar(circulation * torch.exp(-k2 * core**2 / 4), -phase)
    stream = -vorticity / k2.clamp(min=1e-12)
    stream[0, 0] = 0
    return torch.fft.ifft2(torch.stack([-1j * kx * stream, 1j * ky * stream])).real
