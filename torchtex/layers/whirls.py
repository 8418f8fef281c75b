"""Marbling around a point: circles, vortices and drops of ink, as maps of the plane; see `tines`.

On a periodic texture circles and vortices end half a tile away, and drops make room within that
distance.

Source: Lu, Jaffer, Jin, Zhao and Mao 2012, Mathematical marbling; the maps of the torus are ours.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.layers.tines import Number, Size, check, plain

_TINY = 1e-12


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
