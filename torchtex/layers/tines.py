"""Marbling by lines: tines, combs and waves, as maps of the plane; `whirls` has the round ones.

An operation says where a point of the paint goes (`forward`) and where one came from (`back`),
both exactly and differentiably. Points are (2, n), rows and columns in pixels. Parameters are
shares of the texture, so that a design fits any size: rows and columns of its height and width,
lengths of its shorter side; angles are degrees, counter-clockwise from a motion to the right.
Numbers may be tensors, and gradients flow to them.

On a periodic texture every operation acts on the whole plane of tiles, and lines are turned to the
nearest that close on themselves.

Source: Lu, Jaffer, Jin, Zhao and Mao 2012, Mathematical marbling; the maps of the torus are ours.
"""

import math
from dataclasses import dataclass, fields
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

Number = float | int | Tensor
Size = tuple[int, int]
_TURNS = 3  # tiles that a line may cross, each way, before it closes on itself


@runtime_checkable
class Operation(Protocol):
    """One movement of the paint on a texture of a size, which is a tile or is not."""

    def forward(
        self, place: Float[Tensor, "2 n"], size: Size, periodic: bool
    ) -> Float[Tensor, "2 n"]: ...

    def back(
        self, place: Float[Tensor, "2 n"], size: Size, periodic: bool
    ) -> Float[Tensor, "2 n"]: ...


@dataclass(frozen=True)
class Comb:
    """Parallel tines drawn through the paint: each takes along what is near its line.

    Args:
        tines: how many lie side by side across the texture.
        angle: direction in which they are drawn.
        shift: how far the paint on a line moves.
        width: distance from a line at which it moves half as far.
        row, column: a place that one of the lines goes through.

    Raises:
        ValueError: a number out of range.

    Example:
        >>> comb = Comb(2, 0.0, shift=0.25)
        >>> comb.forward(torch.tensor([[1.5], [0.0]]), (4, 4), True).flatten().tolist()
        [1.5, 1.0]
    """

    tines: int = 8
    angle: Number = 90.0
    shift: Number = 0.1
    width: Number = 0.03
    row: Number = 0.5
    column: Number = 0.5

    def __post_init__(self) -> None:
        check(self, ("width",))
        if self.tines < 1:
            raise ValueError(f"tines={self.tines} must be at least 1")

    def forward(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return place + self._slide(place, size, periodic)

    def back(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return place - self._slide(place, size, periodic)

    def _slide(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return _lines(self, place, size, periodic, self.tines)


@dataclass(frozen=True)
class Tine:
    """One line drawn through the paint, as in `Comb`; it goes on without end.

    Args:
        angle, shift, width, row, column: as in `Comb`.

    Example:
        >>> Tine(90.0, shift=0.5).forward(torch.tensor([[0.0], [1.5]]), (4, 4), False).tolist()
        [[-2.0], [1.5]]
    """

    angle: Number = 90.0
    shift: Number = 0.25
    width: Number = 0.06
    row: Number = 0.5
    column: Number = 0.5

    def __post_init__(self) -> None:
        check(self, ("width",))

    def forward(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return place + _lines(self, place, size, periodic, 1 if periodic else 0)

    def back(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return place - _lines(self, place, size, periodic, 1 if periodic else 0)


@dataclass(frozen=True)
class Wave:
    """The paint swings to and fro along stripes. Periodic if rows and columns are whole.

    Args:
        amplitude: how far.
        rows, columns: waves that fit into the height and the width.
        phase: in waves.

    Raises:
        ValueError: no waves.

    Example:
        >>> Wave(0.25, 0, 1).forward(torch.tensor([[0.0], [0.5]]), (4, 4), True)[0].round().item()
        1.0
    """

    amplitude: Number = 0.05
    rows: Number = 0.0
    columns: Number = 3.0
    phase: Number = 0.0

    def __post_init__(self) -> None:
        check(self, ())
        if not plain(self.rows) and not plain(self.columns):
            raise ValueError("rows=0 and columns=0 are no wave; make one of them other than 0")

    def forward(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return place + self._slide(place, size, periodic)

    def back(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return place - self._slide(place, size, periodic)

    def _slide(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        if periodic:
            for name in ("rows", "columns"):
                value = plain(getattr(self, name))
                if value != round(value):
                    raise ValueError(f"{name}={value} must be whole for a periodic texture")
        down, right = self.rows / size[0], self.columns / size[1]
        share = (place + 0.5).unbind(0)
        angle = 2 * math.pi * (down * share[0] + right * share[1] + self.phase)
        swing = self.amplitude * min(size) * torch.sin(angle)
        length = (down * down + right * right) ** 0.5
        return torch.stack([swing * (right / length), swing * (-down / length)])


def check(operation: Any, positive: tuple[str, ...]) -> None:
    """Refuses NaN and infinity in the numbers of an operation, and some that are not above 0.

    Example:
        >>> check(Wave(), ())
        >>> Tine(width=0.0)
        Traceback (most recent call last):
        ValueError: width=0.0 must be above 0
    """
    for field in fields(operation):
        value = getattr(operation, field.name)
        if value is None or isinstance(value, tuple):
            continue
        if not math.isfinite(plain(value)):
            raise ValueError(f"{field.name}={plain(value)} must be finite")
        if field.name in positive and not plain(value) > 0:
            raise ValueError(f"{field.name}={plain(value)} must be above 0")


def plain(value: Number) -> float:
    """A number of an operation as it is now, without its gradient.

    Example:
        >>> plain(torch.tensor(0.5))
        0.5
    """
    return float(value.detach() if isinstance(value, Tensor) else value)


def _lines(line: Any, place: Tensor, size: Size, periodic: bool, count: int) -> Tensor:
    """How far the paint is drawn along `count` lines side by side; 0 is one that has no copies."""
    h, w = size
    if periodic:
        turns = _closed(plain(line.angle), size)
        way = (-turns[0] * h, turns[1] * w)
        length = math.hypot(*way)
        sine, cosine = -way[0] / length, way[1] / length
        gap = h * w / length / count
    else:
        sine, cosine = _sine(line.angle), _sine(line.angle + 90.0)
        gap = (abs(cosine) * h + abs(sine) * w) / max(count, 1)
    centre = (line.row * h - 0.5, line.column * w - 0.5)
    apart = cosine * (place[0] - centre[0]) + sine * (place[1] - centre[1])
    rate = 1 / (line.width * min(size))
    if not count:
        fall = torch.exp2(-apart.abs() * rate)
    else:  # all lines together, and as if each were alone on its own
        gap_now = gap.detach() if isinstance(gap, Tensor) else gap
        apart = (apart - gap * (apart.detach() / gap_now).round()).abs()
        far = torch.exp2(-(gap - apart) * rate)
        fall = (torch.exp2(-apart * rate) + far) / (1 + 2 ** (-gap * rate))
    pull = line.shift * min(size) * fall
    return torch.stack([-sine * pull, cosine * pull])


def _closed(angle: float, size: Size) -> tuple[int, int]:
    """Tiles, up and to the right, that the line closest to an angle crosses until it closes."""
    h, w = size
    way = (math.sin(math.radians(angle)), math.cos(math.radians(angle)))
    known = range(-_TURNS, _TURNS + 1)
    ways = [(up, right) for up in known for right in known if math.gcd(up, right) == 1]
    return max(
        ways,
        key=lambda t: (t[0] * h * way[0] + t[1] * w * way[1]) / math.hypot(t[0] * h, t[1] * w),
    )


def _sine(angle: Number) -> Any:
    """Of degrees, and exact at multiples of 90."""
    if isinstance(angle, Tensor):
        return torch.sin(angle * (math.pi / 180))
    quarters = angle % 360 / 90
    if quarters == round(quarters):
        return (0.0, 1.0, 0.0, -1.0)[round(quarters) % 4]
    return math.sin(math.radians(angle))
