"""Flow fields: how far each pixel moves from one frame to the next.

A flow field is (2, h, w), the displacement of every pixel as (row, column) in pixels per frame: a
pixel at p is at p + f(p) in the next frame. A `Flow` gives the field between frames `frame` and
`frame + 1` for any size, so places and lengths are shares of the texture: a centre (row, column)
of height and width, a radius of the shorter side. Angles are degrees, counter-clockwise from a
motion to the right. Fields are float64 on the CPU, except those given.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

MIDDLE = (0.5, 0.5)


@runtime_checkable
class Flow(Protocol):
    """Anything that says where the pixels of a frame go."""

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]: ...


@runtime_checkable
class Tiling(Protocol):
    """A flow that says whether its fields are tiles."""

    @property
    def periodic(self) -> bool: ...


@dataclass(frozen=True)
class Uniform:
    """Every pixel moves alike. Always periodic.

    Args:
        velocity: (row, column), pixels per frame.

    Example:
        >>> Uniform((0.0, 2.0))(0, 1, 3).tolist()
        [[[0.0, 0.0, 0.0]], [[2.0, 2.0, 2.0]]]
    """

    velocity: tuple[float, float]

    def __post_init__(self) -> None:
        check_numbers({"velocity": self.velocity})

    @property
    def periodic(self) -> bool:
        """True."""
        return True

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        velocity = torch.tensor(self.velocity, dtype=torch.float64)
        return velocity[:, None, None].expand(2, height, width).clone()


@dataclass(frozen=True)
class Given:
    """Fields from an array: one for all frames, or one per frame.

    Args:
        fields: (2, h, w), or (n, 2, h, w) for n + 1 frames. The texture must have their size.
        loop: after the last field comes the first.

    Raises:
        ValueError: what `check_fields` refuses.

    Example:
        >>> Given(torch.ones(2, 4, 5))(7, 4, 5).shape
        torch.Size([2, 4, 5])
    """

    fields: Float[Tensor, "..."]
    loop: bool = False

    def __post_init__(self) -> None:
        check_fields(self.fields)

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        check_frame(frame)
        h, w = self.fields.shape[-2:]
        if (h, w) != (height, width):
            raise ValueError(
                f"flow fields of {h} x {w} pixels do not fit a texture of {height} x {width}; "
                "make them the same size"
            )
        if self.fields.ndim == 3:
            return self.fields
        count = len(self.fields)
        if frame >= count and not self.loop:
            raise ValueError(
                f"frame={frame}: there are {count} flow fields, enough for {count + 1} frames; "
                "ask for fewer frames or let the flow loop"
            )
        return self.fields[frame % count]


@dataclass(frozen=True)
class Scaled:
    """Another flow, faster, slower or backwards.

    Args:
        flow: the other one.
        factor: what its displacements are multiplied by.

    Example:
        >>> Scaled(Uniform((1.0, 2.0)), -1.5)(0, 1, 1).flatten().tolist()
        [-1.5, -3.0]
    """

    flow: Flow
    factor: float

    def __post_init__(self) -> None:
        check_numbers({"factor": self.factor})

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        return self.flow(frame, height, width) * self.factor


@dataclass(frozen=True)
class Summed:
    """Flows added up.

    Args:
        flows: at least one.

    Example:
        >>> Summed((Uniform((1.0, 2.0)), Uniform((0.5, 0.0))))(0, 1, 1).flatten().tolist()
        [1.5, 2.0]
    """

    flows: tuple[Flow, ...]

    def __post_init__(self) -> None:
        if not self.flows:
            raise ValueError("flows=() is empty; give at least one")

    def __call__(self, frame: int, height: int, width: int) -> Float[Tensor, "2 h w"]:
        fields = [flow(frame, height, width) for flow in self.flows]
        return sum(fields[1:], fields[0])


def is_periodic(flow: Flow) -> bool | None:
    """Whether the fields of a flow are tiles; None where nobody knows, as of `Given`.

    Flows that are no tiles may cancel out, which is not looked at.

    Example:
        >>> is_periodic(Uniform((0.0, 1.0))), is_periodic(Given(torch.ones(2, 4, 5)))
        (True, None)
    """
    if isinstance(flow, Scaled):
        return is_periodic(flow.flow)
    if isinstance(flow, Summed):
        parts = [is_periodic(part) for part in flow.flows]
        return False if False in parts else None if None in parts else True
    return flow.periodic if isinstance(flow, Tiling) else None


def check_fields(fields: Tensor, name: str = "fields") -> None:
    """Refuse what is no flow field, nor one per frame.

    Args:
        name: what an error calls `fields`.

    Raises:
        ValueError: in one sentence: wrong rank, no frames or pixels, no floats, NaN, or a
            displacement of more than the height or width.

    Example:
        >>> check_fields(torch.zeros(3, 2, 4, 5))
        >>> check_fields(torch.zeros(4, 5, 2))
        Traceback (most recent call last):
        ValueError: fields: shape (4, 5, 2) must be (2, rows, columns) or (frames, 2, rows, columns)
    """
    shape = tuple(fields.shape)
    if fields.ndim not in (3, 4) or shape[-3] != 2:
        raise ValueError(
            f"{name}: shape {shape} must be (2, rows, columns) or (frames, 2, rows, columns)"
        )
    if not fields.numel():
        raise ValueError(f"{name}: shape {shape} has no frames or no pixels; give at least one")
    if not fields.is_floating_point():
        raise ValueError(f"{name}: {fields.dtype} must be floating point; convert it")
    if not bool(fields.isfinite().all()):
        count = int((~fields.isfinite()).any(-3).sum())
        raise ValueError(f"{name}: NaN or infinity at {count} pixels; replace them")
    for axis, word in ((0, "height"), (1, "width")):
        largest, extent = float(fields.select(-3, axis).abs().max()), shape[axis - 2]
        if largest > extent:
            raise ValueError(
                f"{name}: a pixel moves by {largest:.6g}, more than the {word} of {extent}; give "
                "(row, column) in pixels per frame"
            )


def field_at(flow: Flow, frame: int, size: tuple[int, int]) -> Float[Tensor, "2 h w"]:
    """The field of a flow after a frame, checked.

    Raises:
        ValueError: what `check_fields` refuses, or a field of another size.

    Example:
        >>> field_at(Uniform((0.0, 1.0)), 0, (3, 4)).shape
        torch.Size([2, 3, 4])
    """
    field = flow(frame, *size)
    check_fields(field, "flow")
    if tuple(field.shape) != (2, *size):
        raise ValueError(
            f"flow has fields of {field.shape[-2]}x{field.shape[-1]} and size={size[0]}x{size[1]}; "
            "give both the same"
        )
    return field


def check_flow(flow: Flow, size: tuple[int, int], frames: int = 2) -> None:
    """Refuses a flow whose first field is none, or is of another size, or that ends too early.

    Args:
        frames: how many it has to lead through.

    Raises:
        ValueError: NaN, another rank or size, a displacement larger than the frame, or too few
            given fields.

    Example:
        >>> check_flow(Uniform((0.0, 1.0)), (8, 8))
    """
    field_at(flow, 0, size)
    if frames > 2:
        for part in _given(flow):
            part(frames - 2, *size)


def _given(flow: Flow) -> list[Given]:
    """The parts of a flow that have an end. The last field of others may take long to make."""
    if isinstance(flow, Scaled):
        return _given(flow.flow)
    if isinstance(flow, Summed):
        return [given for part in flow.flows for given in _given(part)]
    return [flow] if isinstance(flow, Given) else []


def check_numbers(numbers: Mapping[str, float | Sequence[float]]) -> None:
    """Refuse NaN and infinity in parameters, by name.

    Example:
        >>> check_numbers({"speed": 2.0, "center": (0.5, 0.5)})
        >>> check_numbers({"speed": math.nan})
        Traceback (most recent call last):
        ValueError: speed=nan must be finite
    """
    for name, value in numbers.items():
        values = value if isinstance(value, Sequence) else (value,)
        if not all(math.isfinite(v) for v in values):
            raise ValueError(f"{name}={value} must be finite")


def check_positive(numbers: Mapping[str, float]) -> None:
    """Refuse parameters that are not above 0, by name.

    Example:
        >>> check_positive({"radius": 0.0})
        Traceback (most recent call last):
        ValueError: radius=0.0 must be above 0
    """
    for name, value in numbers.items():
        if not 0 < value < math.inf:
            raise ValueError(f"{name}={value} must be above 0{' and finite' * (value > 0)}")


def check_frame(frame: int) -> None:
    """Refuse a frame before the first.

    Example:
        >>> check_frame(0)
    """
    if frame < 0:
        raise ValueError(f"frame={frame} must be at least 0")


def from_center(center: tuple[float, float], height: int, width: int) -> Float[Tensor, "2 h w"]:
    """Place of every pixel as (row, column) in pixels from a centre, in float64.

    Args:
        center: shares of height and width; (0, 0) is the outer corner of the first pixel.

    Example:
        >>> from_center((0.5, 0.5), 1, 3)[1].tolist()
        [[-1.0, 0.0, 1.0]]
    """
    rows = torch.arange(height, dtype=torch.float64) + (0.5 - center[0] * height)
    columns = torch.arange(width, dtype=torch.float64) + (0.5 - center[1] * width)
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"))


def traced(
    velocity: Callable[[Tensor], Tensor], place: Float[Tensor, "2 h w"], *, steps: int = 2
) -> Float[Tensor, "2 h w"]:
    """How far a steady velocity carries pixels in one frame, along its curves.

    The velocity itself, taken as a displacement, leaves the curve: whatever turns would also
    spread, and a vortex be a source.

    Args:
        velocity: (2, h, w) of (row, column) places in pixels, pixels per frame.
        place: where the pixels are.
        steps: of the classical Runge-Kutta method.

    Example:
        >>> quarter = lambda p: torch.stack([-p[1], p[0]]) * (math.pi / 2)
        >>> traced(quarter, torch.tensor([[[0.0]], [[1.0]]]), steps=8).round().flatten().tolist()
        [-1.0, -1.0]
    """
    now, h = place, 1 / steps
    for _ in range(steps):
        first = velocity(now)
        second = velocity(now + h / 2 * first)
        third = velocity(now + h / 2 * second)
        fourth = velocity(now + h * third)
        now = now + h / 6 * (first + 2 * second + 2 * third + fourth)
    return now - place
