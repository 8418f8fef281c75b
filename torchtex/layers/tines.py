"""Marbling: drops, tines, combs, waves, circles and vortices, as maps of the plane.

An operation says where a point of the paint goes (`forward`) and where one came from (`back`),
both exactly and differentiably. Points are (2, n), rows and columns in pixels. Parameters are
shares of the texture, so that a design fits any size: rows and columns of its height and width,
lengths of its shorter side; angles are degrees, counter-clockwise from a motion to the right.
Numbers may be tensors, and gradients flow to them.

On a periodic texture every operation acts on the whole plane of tiles: lines are turned to the
nearest that close on themselves, circles end half a tile away, drops make room within that circle.

Source: Lu, Jaffer, Jin, Zhao and Mao 2012, Mathematical marbling; the maps of the torus are ours.
"""

import math
from dataclasses import dataclass, fields
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Number = float | int | Tensor
Size = tuple[int, int]
_TURNS = 3  # tiles that a line may cross, each way, before it closes on itself
_TINY = 1e-12


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


@dataclass(frozen=True)
class Circle:
    """A tine drawn around a circle, once or in part.

    Args:
        row, column: its centre.
        radius: of the circle.
        shift: how far the paint on it moves, counter-clockwise.
        width: distance from it at which the paint turns half as far.

    Example:
        >>> point = torch.tensor([[1.5], [2.5]])
        >>> moved = Circle(radius=0.25, shift=0.25 * math.pi / 2).forward(point, (4, 4), False)
        >>> (10 * moved).round().flatten().tolist()
        [5.0, 15.0]
    """

    row: Number = 0.5
    column: Number = 0.5
    radius: Number = 0.25
    shift: Number = 0.25
    width: Number = 0.06

    def __post_init__(self) -> None:
        check(self, ("radius", "width"))

    def forward(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return _turned(self, place, size, periodic, 1)

    def back(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return _turned(self, place, size, periodic, -1)

    def angle(self, distance: Tensor, edge: float | None) -> Tensor:
        """Radians by which what lies so far away, in shares, is turned; 0 beyond the edge."""
        if edge is not None and plain(self.radius) >= 0.45:
            raise ValueError(
                f"radius={plain(self.radius)} must be below 0.45 for a circle on a periodic texture"
            )
        fall = torch.exp2(-(distance - self.radius).abs() / self.width)
        fall = fall * _faded(distance, edge) / _faded(self.radius + 0 * distance, edge)
        return self.shift / self.radius * fall


@dataclass(frozen=True)
class Vortex:
    """The paint stirred around a point.

    Args:
        row, column: the point.
        turn: degrees at the point, counter-clockwise.
        radius: distance at which the paint turns half as far.

    Example:
        >>> Vortex(turn=90).forward(torch.tensor([[1.5], [1.6]]), (4, 4), False).round().tolist()
        [[1.0], [2.0]]
    """

    row: Number = 0.5
    column: Number = 0.5
    turn: Number = 180.0
    radius: Number = 0.15

    def __post_init__(self) -> None:
        check(self, ("radius",))

    def forward(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return _turned(self, place, size, periodic, 1)

    def back(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        return _turned(self, place, size, periodic, -1)

    def angle(self, distance: Tensor, edge: float | None) -> Tensor:
        """Radians by which what lies so far away, in shares, is turned; 0 beyond the edge."""
        fall = torch.exp2(-((distance / self.radius) ** 2))
        return self.turn * (math.pi / 180) * fall * _faded(distance, edge)


@dataclass(frozen=True)
class Drop:
    """A drop of ink, which pushes the paint away from its centre. Areas outside are kept.

    On a periodic texture there is no outside that they could go to: the paint within half a tile
    is squeezed. What lay in the very centre comes to lie on the rim, so that an undo cannot tell
    its directions apart there.

    Args:
        row, column: its centre.
        radius: of the drop.
        color: of the ink, one value per channel; None shows the texture, as it was there.

    Example:
        >>> drop = Drop(radius=0.25)
        >>> drop.covers(torch.tensor([[1.5, 0.0], [1.5, 0.0]]), (4, 4), False).tolist()
        [True, False]
    """

    row: Number = 0.5
    column: Number = 0.5
    radius: Number = 0.1
    color: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        check(self, ("radius",))
        if self.color is not None and not all(0 <= value <= 1 for value in self.color):
            raise ValueError(f"color={self.color} must lie in 0..1")

    def forward(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        offset, square, own = self._round(place, size, periodic)
        if periodic:
            edge = min(size) ** 2 / 4
            room = edge - own
            far = (edge - square).clamp(min=0)
            share = 2 * far / (room + (room * room + 4 * own * far) ** 0.5)
            pushed = torch.where(square < edge, edge - share * room, square)
        else:
            pushed = square + own
        return place + offset * ((pushed / square) ** 0.5 - 1)

    def back(self, place: Tensor, size: Size, periodic: bool) -> Tensor:
        offset, square, own = self._round(place, size, periodic)
        taken = own
        if periodic:
            edge = min(size) ** 2 / 4
            taken = own * ((edge - square) / (edge - own)).clamp(0, 1) ** 2
        before = (square - taken).clamp(min=_TINY)
        moved = place + offset * ((before / square) ** 0.5 - 1)
        return torch.where(square < own, place, moved)

    def covers(self, place: Float[Tensor, "2 n"], size: Size, periodic: bool) -> Bool[Tensor, "n"]:
        """Whether a place lies in the drop, once it has spread."""
        _, square, own = self._round(place, size, periodic)
        return square < own

    def _round(self, place: Tensor, size: Size, periodic: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Offsets from the centre, their squares, and that of the radius."""
        if periodic and plain(self.radius) >= 0.45:
            raise ValueError(
                f"radius={plain(self.radius)} must be below 0.45 for a drop on a periodic texture"
            )
        offset = _offset(self, place, size, periodic)
        own = (self.radius * min(size)) ** 2 * torch.ones((), dtype=place.dtype)
        return offset, offset.square().sum(0).clamp(min=_TINY), own.to(place.device)


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


def _offset(what: Any, place: Tensor, size: Size, periodic: bool) -> Tensor:
    """From the centre, or the nearest copy of it."""
    offsets = []
    for at, share, extent in zip(place.unbind(0), (what.row, what.column), size, strict=True):
        apart = at - (share * extent - 0.5)
        if periodic:
            apart = apart - extent * (apart.detach() / extent).round()
        offsets.append(apart)
    return torch.stack(offsets)


def _turned(
    what: "Circle | Vortex", place: Tensor, size: Size, periodic: bool, sign: int
) -> Tensor:
    offset = _offset(what, place, size, periodic)
    distance = offset.square().sum(0).clamp(min=_TINY).sqrt() / min(size)
    angle = sign * what.angle(distance, 0.5 if periodic else None)
    cosine, sine = torch.cos(angle), torch.sin(angle)
    row = cosine * offset[0] - sine * offset[1]
    column = sine * offset[0] + cosine * offset[1]
    return place + torch.stack([row, column]) - offset


def _faded(distance: Tensor, edge: float | None) -> Tensor:
    """1 in the middle, 0 from the edge on, smooth there."""
    if edge is None:
        return torch.ones_like(distance)
    return (1 - (distance / edge) ** 2).clamp(min=0) ** 2


def _sine(angle: Number) -> Any:
    """Of degrees, and exact at multiples of 90."""
    if isinstance(angle, Tensor):
        return torch.sin(angle * (math.pi / 180))
    quarters = angle % 360 / 90
    if quarters == round(quarters):
        return (0.0, 1.0, 0.0, -1.0)[round(quarters) % 4]
    return math.sin(math.radians(angle))
