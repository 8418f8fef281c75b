"""Flows drawn by hand: arrows and lines, and a smooth field that follows them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.flow.fields import check_numbers, check_positive, from_center
from torchtex.quadratic import threads

_SPACING = 0.05  # of the points on a stroke, a share of the shorter side
_BAND = 2**14  # pixels at a time


@dataclass(frozen=True)
class Strokes:
    """Pixels follow drawn lines; between them the motion is interpolated.

    Points are set on the lines, and each component of the velocity there, the unit tangent times
    `speed`, is interpolated by radial basis functions: sum of a_i phi(norm(p - p_i)), and for
    thin plates a + <b, p>. Nothing moves faster than `speed`.

    Args:
        strokes: each a line through points (row, column), shares of height and width. Two points
            are an arrow.
        speed: pixels per frame on the lines.
        width: of Gaussians, a share of the shorter side: pixels far from all lines rest. None:
            thin plates, and everything moves.
        smoothing: above 0 the field need not follow lines that contradict each other exactly.
        periodic: distances are chords of a torus, so that the field is a tile. Lines may leave
            the texture and come in at the other side: their points may lie outside [0, 1].

    Raises:
        ValueError: no stroke, or one of no length.

    Source: Duchon 1977, thin plates r^2 log r; Wahba 1990, smoothing.

    Example:
        >>> field = Strokes((((0.5, 0.1), (0.5, 0.9)),), speed=2.0)(0, 4, 6)
        >>> field[:, 2, 3].round(decimals=3).abs().tolist()  # to the right
        [0.0, 2.0]
    """

    strokes: Sequence[Sequence[tuple[float, float]]]
    speed: float = 2.0
    width: float | None = None
    smoothing: float = 0.1
    periodic: bool = False

    def __post_init__(self) -> None:
        check_numbers({"speed": self.speed})
        if self.width is not None:
            check_positive({"width": self.width})
        if not 0 <= self.smoothing < math.inf:
            raise ValueError(f"smoothing={self.smoothing} must be at least 0 and finite")
        if not self.strokes:
            raise ValueError("strokes are empty; draw at least one")
        for number, stroke in enumerate(self.strokes):
            for point in stroke:
                check_numbers({f"strokes[{number}]": point})
            if len({tuple(point) for point in stroke}) < 2:
                raise ValueError(f"strokes[{number}] has no length; give it two different points")

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        size = torch.tensor([height, width], dtype=torch.float64) / min(height, width)
        # the products and the solver would round in another order with more threads
        with threads(1):
            drawn = [_dotted(stroke, size) for stroke in self.strokes]
            points = self._features(torch.cat([points for points, _ in drawn]), size)
            pixels = from_center((0.0, 0.0), height, width).flatten(1).T / min(height, width)
            pixels = self._features(pixels, size)
            middle = points.mean(0)
            weights, slopes = self._solved(points - middle, torch.cat([t for _, t in drawn]))
            bands = [
                self._kernel(band - middle, points - middle) @ weights
                + _affine(band - middle) @ slopes
                for band in pixels.split(_BAND)
            ]
        field = torch.cat(bands)
        pace = field.square().sum(1, keepdim=True).sqrt()
        return (self.speed * field / pace.clamp(min=1)).T.reshape(2, height, width)

    def _features(self, points: Float[Tensor, "n 2"], size: Float[Tensor, "2"]) -> Tensor:
        """Coordinates in which distances are taken, in shorter sides."""
        if not self.periodic:
            return points
        turn = 2 * math.pi * points / size
        radius = size / (2 * math.pi)
        return torch.cat([radius * torch.cos(turn), radius * torch.sin(turn)], 1)

    def _kernel(self, a: Float[Tensor, "n d"], b: Float[Tensor, "m d"]) -> Tensor:
        squared = (a[:, None] - b[None]).square().sum(-1)
        if self.width is not None:
            return torch.exp(-squared / (2 * self.width**2))
        return squared * squared.clamp(min=1e-30).log() / 2

    def _solved(
        self, points: Float[Tensor, "n d"], tangents: Float[Tensor, "n 2"]
    ) -> tuple[Tensor, Tensor]:
        """Weights of the points and of 1 and the coordinates; the smallest if many will do."""
        n, low = len(points), _affine(points)
        # thin plates are that much lower than Gaussians between neighbouring points
        ridge = self.smoothing * (0.01 if self.width is None else 1.0)
        matrix = self._kernel(points, points) + ridge * torch.eye(n, dtype=torch.float64)
        if self.width is not None:
            return torch.linalg.lstsq(matrix, tangents, driver="gelsd").solution, low.new_zeros(
                low.shape[1], 2
            )
        corner = low.new_zeros(low.shape[1], low.shape[1])
        system = torch.cat([torch.cat([matrix, low], 1), torch.cat([low.T, corner], 1)])
        wanted = torch.cat([tangents, low.new_zeros(low.shape[1], 2)])
        solution = torch.linalg.lstsq(system, wanted, driver="gelsd", rcond=1e-9).solution
        return solution[:n], solution[n:]


def _affine(points: Float[Tensor, "n d"]) -> Tensor:
    return torch.cat([torch.ones_like(points[:, :1]), points], 1)


def _dotted(
    stroke: Sequence[tuple[float, float]], size: Float[Tensor, "2"]
) -> tuple[Tensor, Tensor]:
    """Points on a line at even distances, in shorter sides, and the unit tangents there."""
    corners = torch.tensor([list(p) for p in stroke], dtype=torch.float64) * size
    steps = corners.diff(dim=0)
    lengths = steps.square().sum(1).sqrt()
    corners, steps = corners[:-1][lengths > 0], steps[lengths > 0]
    lengths = lengths[lengths > 0]
    ends = lengths.cumsum(0)
    count = max(2, round(float(ends[-1]) / _SPACING))
    at = (torch.arange(count, dtype=torch.float64) + 0.5) / count * ends[-1]
    which = torch.searchsorted(ends, at).clamp(max=len(ends) - 1)
    share = (at - (ends - lengths)[which]) / lengths[which]
    return corners[which] + share[:, None] * steps[which], (steps / lengths[:, None])[which]
