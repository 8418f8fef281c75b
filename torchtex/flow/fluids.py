"""Flows of fluids that change: the double gyre, and a small simulation of a stirred fluid."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.flow.fields import (
    check_frame,
    check_numbers,
    check_positive,
    from_center,
    traced,
)
from torchtex.flow.warps import sample
from torchtex.quadratic import threads

_KEPT = 16  # one state in so many stays in memory, so that going back is cheap too
_STIRRERS = 16


@dataclass(frozen=True)
class DoubleGyre:
    """Two whirls side by side; the wall between them swings to and fro. No area changes.

    Stream function sin(pi f) sin(pi y) with f = x + a (x^2 - 2 x), a = swing sin(2 pi t / period),
    x in [0, 2] along the width and y in [0, 1] along the height.

    Args:
        speed: largest, pixels per frame, when the wall is in the middle.
        swing: how far it goes, in [0, 0.5).
        period: frames until it is back.
        periodic: two more whirls below, and all of them slide to and fro; a tile.

    Source: Shadden, Lekien and Marsden 2005.

    Example:
        >>> DoubleGyre()(0, 8, 16).shape
        torch.Size([2, 8, 16])
    """

    speed: float = 2.5
    swing: float = 0.25
    period: float = 48.0
    periodic: bool = False

    def __post_init__(self) -> None:
        check_numbers({"speed": self.speed})
        check_positive({"period": self.period})
        if not 0 <= self.swing < 0.5:
            raise ValueError(f"swing={self.swing} must lie in [0, 0.5)")

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        tall = 2 if self.periodic else 1
        across, down = math.pi * tall / height, 2 * math.pi / width
        unit = self.speed / max(across, down)
        a = self.swing * math.sin(2 * math.pi * math.fmod(frame / self.period, 1.0))

        def velocity(place: Tensor) -> Tensor:
            y, x = across * place[0], 2 / width * place[1]
            if self.periodic:
                f, slope = x + a, torch.ones_like(x)
            else:
                f, slope = x + a * (x.square() - 2 * x), 1 + a * (2 * x - 2)
            f = math.pi * f
            row = unit * down * slope * torch.cos(f) * torch.sin(y)
            return torch.stack([row, -unit * across * torch.sin(f) * torch.cos(y)])

        return traced(velocity, from_center((0.0, 0.0), height, width))


@dataclass(frozen=True)
class StableFluid:
    """A fluid without compression, stirred at random places; simulated from frame 0 on.

    Each frame the velocities are carried along themselves, pushed, damped by viscosity, and made
    free of divergence in the Fourier domain. They are then scaled to keep their mean square.
    Asking for frames in order costs one step each; the state of each 16th frame is kept.

    Args:
        seed: of the places and directions of the forces.
        speed: root mean square, pixels per frame.
        scale: size of the stirrers, a share of the shorter side.
        stir: new velocity per frame, as a share of `speed`.
        viscosity: pixels^2 per frame.
        periodic: a torus; otherwise a box whose walls nothing passes.
        resolution: cells along the shorter side, if the texture has as many pixels.

    Source: Stam 1999, Stable Fluids; Stam 2001 for the Fourier domain. Walls are mirrors.

    Example:
        >>> StableFluid(seed=1, resolution=8)(2, 16, 12).shape
        torch.Size([2, 16, 12])
    """

    seed: int = 0
    speed: float = 1.5
    scale: float = 0.1
    stir: float = 0.15
    viscosity: float = 0.2
    periodic: bool = False
    resolution: int = 64
    _states: dict[tuple[int, int], dict[int, Tensor]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        check_positive({"scale": self.scale})
        for name in ("speed", "stir", "viscosity"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 0 and finite")
        if self.resolution < 4:
            raise ValueError(f"resolution={self.resolution} must be at least 4 cells")

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        check_frame(frame)
        shorter = min(height, width)
        cells = min(self.resolution, shorter) / shorter  # per pixel
        with threads(1):
            state = self._state(frame, height, width, cells)
            size = torch.tensor([height, width], dtype=torch.float64)
            ratio = (torch.tensor(state.shape[1:], dtype=torch.float64) / size)[:, None, None]
            here = from_center((0.0, 0.0), height, width)
            fine = self._read(state, here * ratio - 0.5) / ratio
            return traced(
                lambda place: sample(fine, place - 0.5, periodic=self.periodic, cubic=False), here
            )

    def _state(self, frame: int, height: int, width: int, cells: float) -> Tensor:
        """Velocity in cells per frame, of the nearest kept frame before, stepped to this one."""
        if (height, width) not in self._states and len(self._states) >= 4:
            self._states.pop(next(iter(self._states)))
        states = self._states.setdefault((height, width), {})
        size = (max(1, round(height * cells)), max(1, round(width * cells)))
        if 0 not in states:
            states[0] = self._steadied(self._force(0, size), cells)
        now = max(known for known in states if known <= frame)
        state = states[now]
        while now < frame:
            state = self._step(state, now, cells)
            now += 1
            if now % _KEPT == 0:
                states[now] = state
        for known in [known for known in states if known % _KEPT]:
            del states[known]
        states[frame] = state
        return state

    def _step(self, state: Tensor, frame: int, cells: float) -> Tensor:
        here = from_center((0.0, 0.0), state.shape[1], state.shape[2]) - 0.5
        moved = self._read(state, here - state)
        push = self.stir * self._steadied(self._force(frame + 1, state.shape[1:]), cells)
        return self._steadied(moved + push, cells)

    def _read(self, state: Tensor, at: Tensor) -> Tensor:
        """The field at fractional cells; walls are mirrors, so that it never points outside."""
        if self.periodic:
            return sample(state, at, periodic=True)
        return sample(_mirrored(state), at, periodic=True)

    def _force(self, frame: int, size: tuple[int, ...]) -> Tensor:
        """Gaussian brushes at random places; the direction of each turns at its own rate."""
        generator = torch.Generator().manual_seed(self.seed)
        draw = torch.rand(_STIRRERS, 4, generator=generator, dtype=torch.float64)
        width = self.scale * min(size)
        total = torch.zeros(2, *size, dtype=torch.float64)
        for row, column, start, rate in draw.tolist():
            offset = from_center((row, column), size[0], size[1])
            if self.periodic:
                span = torch.tensor(size, dtype=torch.float64)[:, None, None]
                offset = offset - span * (offset / span).round()
            blob = torch.exp(-offset.square().sum(0) / (2 * width**2))
            angle = 2 * math.pi * (start + (rate - 0.5) * frame / 24)
            total[0] += math.sin(angle) * blob
            total[1] += math.cos(angle) * blob
        return total

    def _steadied(self, state: Tensor, cells: float) -> Tensor:
        """Free of divergence, damped, and scaled to the wanted mean square."""
        free = self._projected(state, self.viscosity * cells**2)
        root = float(free.square().mean().sqrt()) * math.sqrt(2)
        return free * (self.speed * cells / root) if root > 1e-12 else free

    def _projected(self, state: Tensor, viscosity: float) -> Tensor:
        whole = state if self.periodic else _mirrored(state)
        h, w = whole.shape[1:]
        ky = 2 * math.pi * torch.fft.fftfreq(h, dtype=torch.float64)[:, None]
        kx = 2 * math.pi * torch.fft.rfftfreq(w, dtype=torch.float64)[None]
        k2 = ky.square() + kx.square()
        spectrum = torch.fft.rfft2(whole)
        along = (ky * spectrum[0] + kx * spectrum[1]) / k2.clamp(min=1e-12)
        spectrum = (spectrum - torch.stack([ky * along, kx * along])) * torch.exp(-viscosity * k2)
        spectrum[:, 0, 0] = 0  # no wind
        free = torch.fft.irfft2(spectrum, s=(h, w))
        return free[:, : state.shape[1], : state.shape[2]].contiguous()


def _mirrored(state: Tensor) -> Tensor:
    """The box and its mirror images, a torus of twice the size: the wall between is not passed."""
    sign = torch.tensor([-1.0, 1.0], dtype=state.dtype)[:, None, None]
    tall = torch.cat([state, sign * state.flip(1)], 1)
    return torch.cat([tall, -sign * tall.flip(2)], 2)
