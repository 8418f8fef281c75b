"""Flows with a formula: shear, rotation, sources, sinks, saddles and waves."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.flow.fields import MIDDLE, check_numbers, check_positive, from_center, traced


@dataclass(frozen=True)
class Shear:
    """Layers that slide past each other: `speed` forwards at one side, backwards at the other.

    Args:
        speed: largest, pixels per frame.
        angle: direction of the motion. A positive speed moves what lies to its left forwards.
        periodic: the profile is a sine across the texture; `angle` is then a multiple of 90.

    Example:
        >>> Shear(2.0)(0, 4, 1)[1].flatten().tolist()
        [1.5, 0.5, -0.5, -1.5]
    """

    speed: float = 2.0
    angle: float = 0.0
    periodic: bool = False

    def __post_init__(self) -> None:
        check_numbers({"speed": self.speed, "angle": self.angle})
        _check_axis(self.angle, self.periodic)

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        along, across = _direction(self.angle), _direction(self.angle + 90)
        half = (abs(across[0]) * height + abs(across[1]) * width) / 2
        offset = from_center(MIDDLE, height, width)
        share = (across[0] * offset[0] + across[1] * offset[1]) / half
        profile = self.speed * (torch.sin(math.pi * share) if self.periodic else share)
        return torch.stack([along[0] * profile, along[1] * profile])


@dataclass(frozen=True)
class Rotation:
    """A rigid turn; no torus has one, so it is never periodic.

    Args:
        degrees: per frame, counter-clockwise.
        center: (row, column), shares of height and width.

    Example:
        >>> Rotation(90.0)(0, 1, 3)[0].sign().tolist()  # the pixel on the right goes up
        [[1.0, 0.0, -1.0]]
    """

    degrees: float = 2.0
    center: tuple[float, float] = MIDDLE

    def __post_init__(self) -> None:
        check_numbers({"degrees": self.degrees, "center": self.center})

    @property
    def periodic(self) -> bool:
        """False."""
        return False

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        row, column = from_center(self.center, height, width)
        turn = math.radians(self.degrees)
        sine, less = math.sin(turn), 2 * math.sin(turn / 2) ** 2  # less = 1 - cos
        return torch.stack([-(less * row + sine * column), sine * row - less * column])


@dataclass(frozen=True)
class Source:
    """Pixels stream away from a centre, where new ones appear; a negative speed is a sink.

    The speed is proportional to the distance inside the core, constant far outside.

    Args:
        speed: pixels per frame, far from the centre.
        center: (row, column), shares of height and width.
        core: its radius, a share of the shorter side; a large one makes an even zoom.
        periodic: sines across the texture, with a sink half a tile away in both directions.

    Example:
        >>> Source(1.0)(0, 3, 3)[0, :, 1].sign().tolist()
        [-1.0, 0.0, 1.0]
    """

    speed: float = 1.5
    center: tuple[float, float] = MIDDLE
    core: float = 0.15
    periodic: bool = False

    def __post_init__(self) -> None:
        check_numbers({"speed": self.speed, "center": self.center})
        check_positive({"core": self.core})

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        offset = from_center(self.center, height, width)
        if self.periodic:
            size = torch.tensor([height, width], dtype=torch.float64)[:, None, None]
            return self.speed * torch.sin(2 * math.pi * offset / size)
        core = self.core * min(height, width)
        return self.speed * offset / (offset.square().sum(0) + core**2).sqrt()


@dataclass(frozen=True)
class Sink:
    """Pixels stream to a centre and vanish there: `Source` backwards.

    Args:
        speed, center, core, periodic: as in `Source`.

    Example:
        >>> Sink(1.0)(0, 3, 3)[0, :, 1].sign().tolist()
        [1.0, 0.0, -1.0]
    """

    speed: float = 1.5
    center: tuple[float, float] = MIDDLE
    core: float = 0.15
    periodic: bool = False

    def __post_init__(self) -> None:
        Source(self.speed, self.center, self.core, self.periodic)  # has the same limits

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        return -Source(self.speed, self.center, self.core, self.periodic)(frame, height, width)


@dataclass(frozen=True)
class Saddle:
    """Pixels leave a centre along one axis and come in along the other; no area changes.

    Args:
        speed: pixels per frame, half the shorter side away from the centre.
        center: (row, column), shares of height and width.
        angle: of the axis along which they leave.
        periodic: whirls in the four quarters of the tile; `angle` is then a multiple of 90.

    Example:
        >>> Saddle(1.0)(0, 1, 3)[1].sign().tolist()
        [[-1.0, 0.0, 1.0]]
    """

    speed: float = 2.0
    center: tuple[float, float] = MIDDLE
    angle: float = 0.0
    periodic: bool = False

    def __post_init__(self) -> None:
        check_numbers({"speed": self.speed, "center": self.center, "angle": self.angle})
        _check_axis(self.angle, self.periodic)

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        size = torch.tensor([height, width], dtype=torch.float64)[:, None, None]
        twice = math.radians(2 * self.angle)
        cosine, sine = math.cos(twice), math.sin(twice)

        def velocity(offset: Tensor) -> Tensor:
            if self.periodic:  # of the stream function sin sin
                wave = 2 * math.pi * offset / size
                way = torch.sin(wave) * torch.cos(wave.flip(0)) * size / max(height, width)
            else:
                way = offset * (2 / min(height, width))
            # the mirror image in the axis
            row, column = -cosine * way[0] - sine * way[1], cosine * way[1] - sine * way[0]
            return self.speed * torch.stack([row, column])

        return traced(velocity, from_center(self.center, height, width))


@dataclass(frozen=True)
class Wave:
    """Pixels swing across the direction in which a wave travels. Periodic if `cycles` are whole.

    Args:
        amplitude: largest speed, pixels per frame.
        cycles: waves that fit into the (height, width); their signs say where it travels.
        period: frames until it looks the same; 0 stands still.

    Example:
        >>> Wave(1.0, (0.0, 1.0), period=0.0)(0, 1, 4)[0].sign().tolist()
        [[-1.0, -1.0, 1.0, 1.0]]
    """

    amplitude: float = 1.5
    cycles: tuple[float, float] = (0.0, 2.0)
    period: float = 24.0

    def __post_init__(self) -> None:
        check_numbers({"amplitude": self.amplitude, "cycles": self.cycles, "period": self.period})
        if not any(self.cycles):
            raise ValueError("cycles=(0, 0) are no wave; make one of them other than 0")

    @property
    def periodic(self) -> bool:
        """Whether whole waves fit into the texture."""
        return all(float(count).is_integer() for count in self.cycles)

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        vector = (self.cycles[0] / height, self.cycles[1] / width)
        corner = from_center((0.0, 0.0), height, width)
        phase = vector[0] * corner[0] + vector[1] * corner[1]
        if self.period:
            phase = phase - math.fmod(frame / self.period, 1.0)
        swing = self.amplitude * torch.sin(2 * math.pi * phase) / math.hypot(*vector)
        return torch.stack([-vector[1] * swing, vector[0] * swing])


def _direction(angle: float) -> tuple[float, float]:
    return -math.sin(math.radians(angle)), math.cos(math.radians(angle))


def _check_axis(angle: float, periodic: bool) -> None:
    if periodic and angle % 90:
        raise ValueError(f"angle={angle} must be a multiple of 90 for a periodic flow")
