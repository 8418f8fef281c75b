"""The camera that looks at a scene, and the light that falls on it."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

Place = tuple[float, float, float]


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from.

    Args:
        azimuth: degrees around the upright axis; 0 is in front, 90 at the right.
        elevation: degrees above the level; from 90, straight above, the side at the azimuth is
            the lower one in the picture.
        distance: from the target.
        target: in the middle of the picture.
        fov: degrees that the shorter side of the picture spans.

    Raises:
        ValueError: a number out of range.

    Example:
        >>> [round(x, 6) for x in Camera(90.0, 0.0, 2.0).eye]
        [2.0, 0.0, 0.0]
    """

    azimuth: float = 20.0
    elevation: float = 20.0
    distance: float = 4.0
    target: Place = (0.0, 0.0, 0.0)
    fov: float = 36.0

    def __post_init__(self) -> None:
        if not -90 <= self.elevation <= 90:
            raise ValueError(f"elevation={self.elevation} must lie in -90..90 degrees")
        if not 0 < self.distance < math.inf:
            raise ValueError(f"distance={self.distance} must be above 0")
        if not 1 <= self.fov <= 150:
            raise ValueError(f"fov={self.fov} must lie in 1..150 degrees")

    @property
    def eye(self) -> Place:
        """Where the camera is."""
        x, y, z = direction(self.azimuth, self.elevation)
        a, b, c = self.target
        return (a + self.distance * x, b + self.distance * y, c + self.distance * z)

    def seen(self, points: Float[Tensor, "n 3"], size: tuple[int, int]) -> Float[Tensor, "n 3"]:
        """Points as `rasterize` takes them, for a picture of that size."""
        eye = points.new_tensor(self.eye).double()
        ahead = F.normalize(points.new_tensor(self.target).double() - eye, dim=0)
        turn = math.radians(self.azimuth)  # level, so it is known from straight above too
        right = ahead.new_tensor([math.cos(turn), 0.0, -math.sin(turn)])
        above = torch.linalg.cross(right, ahead)
        x, y, z = ((points.double() - eye) @ torch.stack([right, above, ahead], 1)).unbind(1)
        scale = min(size) / 2 / math.tan(math.radians(self.fov) / 2)
        middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)
        return torch.stack([scale * x + middle[1] * z, -scale * y + middle[0] * z, z], 1)


@dataclass(frozen=True)
class Light:
    """A far light, and a sky.

    Args:
        azimuth, elevation: where it comes from, as for `Camera`.
        strength: of the light on a surface that faces it.
        sky: of what comes from all around.

    Raises:
        ValueError: a number out of range.

    Example:
        >>> Light(sky=0.4).strength
        0.85
    """

    azimuth: float = -35.0
    elevation: float = 50.0
    strength: float = 0.85
    sky: float = 0.3

    def __post_init__(self) -> None:
        if not -90 <= self.elevation <= 90:
            raise ValueError(f"elevation={self.elevation} must lie in -90..90 degrees")
        for name in ("strength", "sky"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 0, and finite")


def direction(azimuth: float, elevation: float) -> Place:
    """Towards a place in degrees, as for `Camera`.

    Example:
        >>> direction(0.0, 0.0)
        (0.0, 0.0, 1.0)
    """
    a, e = math.radians(azimuth), math.radians(elevation)
    return (math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e))
