"""Strokes of `torchtex edit` as they are written, on the command line or in a JSON file."""

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchtex.cli.files import extent_of, hint

if TYPE_CHECKING:
    import torch

    from torchtex.recipes.strokes import Stroke

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_STROKE = re.compile(
    rf"(?P<mask>.+):(?P<row>[-+]?\d+),(?P<col>[-+]?\d+)"
    rf"(?::(?P<rotation>{_NUMBER})(?::(?P<scale>{_NUMBER}))?)?"
)
_SHAPES = ("mask", "path", "circles", "polygon")
_KEYS = (*_SHAPES, "radius", "offset", "rotation", "scale", "mirror")


@dataclass(frozen=True)
class Mark:
    """A stroke as it was written: on the command line or in a file.

    Args:
        where: what an error calls it.
        offset: rows and columns that it moves.
        mask: file to be loaded, or None.
        shape: name of the drawn shape, when there is no file.
        points: rows of two numbers (path, polygon) or three (circles).
        radius: of the brush along a path.
        rotation: in degrees.
        scale: 1 keeps the size.
        mirror: exchange left and right.

    Example:
        >>> written_mark("flower.png:-20,35:90").rotation
        90.0
    """

    where: str
    offset: tuple[int, int]
    mask: str | None = None
    shape: str = "mask"
    points: tuple[tuple[float, ...], ...] = ()
    radius: float = 0.0
    rotation: float = 0.0
    scale: float = 1.0
    mirror: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.scale < math.inf:
            raise ValueError(f"{self.where}: scale={self.scale} must be above 0, and finite")

    def stroke(self, reference: "torch.Tensor") -> "Stroke":
        """Loads or draws the mask.

        Raises:
            ValueError: no such file, one of another size, or nothing painted.
        """
        from torchtex.recipes.strokes import Stroke

        try:
            mask = self._mask(extent_of(reference))
            return Stroke(mask, self.offset, self.rotation, self.scale, self.mirror)
        except ValueError as error:
            raise ValueError(f"{self.where}: {error}") from None

    def _mask(self, size: tuple[int, int]) -> "torch.Tensor":
        import torch

        from torchtex import image as images
        from torchtex.recipes.strokes import brush, polygon

        if self.mask is not None:
            grey = images.luminance(images.load(self.mask, alpha=False, name="mask").image)
            if tuple(grey.shape) != size:
                raise ValueError(
                    f"mask={self.mask!r} has {grey.shape[0]}x{grey.shape[1]} pixels and the "
                    f"reference {size[0]}x{size[1]}; paint on a mask of the reference's size"
                )
            return grey
        if self.shape == "path":
            return brush(size, [(p[0], p[1]) for p in self.points], self.radius)
        if self.shape == "polygon":
            return polygon(size, [(p[0], p[1]) for p in self.points])
        dots = [brush(size, [(r, c)], radius) for r, c, radius in self.points]
        return torch.stack(dots).any(0)


def written_mark(text: str) -> Mark:
    """A stroke of the form MASK:ROW,COL[:rotation[:scale]].

    Raises:
        ValueError: another form.

    Example:
        >>> written_mark("marks/one.png:12,-4").offset
        (12, -4)
    """
    found = _STROKE.fullmatch(text)
    if found is None:
        raise ValueError(
            f"stroke={text!r} is not MASK:ROW,COL[:rotation[:scale]]; "
            "write it like mark.png:-20,35 or mark.png:-20,35:90:1.5"
        )
    return Mark(
        f"stroke={text!r}",
        (int(found["row"]), int(found["col"])),
        mask=found["mask"],
        rotation=float(found["rotation"] or 0),
        scale=float(found["scale"] or 1),
    )


def marks_in(path: Path) -> list[Mark]:
    """The strokes of a JSON file.

    Raises:
        ValueError: the file cannot be read, is no list of strokes, or has a key or value that
            is none.

    Example:
        >>> marks_in(Path("missing.json"))
        Traceback (most recent call last):
        ValueError: ...
    """
    where = f"strokes={str(path)!r}"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{where} cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where} is not JSON ({error}); write a list of strokes") from None
    if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
        raise ValueError(
            f"{where} is no list of strokes; "
            'write [{"path": [[row, col], ...], "radius": r, "offset": [row, col]}, ...]'
        )
    if not found:
        raise ValueError(f"{where} holds no strokes; write at least one")
    marks = [
        _Item(f"{where}, stroke {number}", item).mark(path.parent)
        for number, item in enumerate(found, 1)
    ]
    return marks


@dataclass(frozen=True)
class _Item:
    """One stroke of a JSON file, with its values checked one by one."""

    where: str
    values: dict[str, Any]

    def mark(self, folder: Path) -> Mark:
        for key in self.values:
            if key not in _KEYS:
                raise ValueError(f"{self.where}: {key!r} is unknown; {hint(key, _KEYS)}")
        shapes = [key for key in _SHAPES if key in self.values]
        if len(shapes) != 1:
            raise ValueError(
                f"{self.where} has {' and '.join(shapes) or 'no mark'}; give one of "
                f"{', '.join(_SHAPES)}"
            )
        if ("radius" in self.values) != (shapes[0] == "path"):
            raise ValueError(f"{self.where}: a radius goes with a path, and a path needs one")
        offset = self._numbers("offset", self.values.get("offset"), 2)
        if any(value != round(value) for value in offset):
            raise ValueError(f"{self.where}: offset={list(offset)} must be whole numbers")
        mask: str | None = None
        points: tuple[tuple[float, ...], ...] = ()
        if shapes[0] == "mask":
            name = self.values["mask"]
            if not isinstance(name, str) or not name:
                raise ValueError(f"{self.where}: mask={name!r} must be the name of a file")
            mask = str(folder / name)
        else:
            points = self._points(shapes[0], 3 if shapes[0] == "circles" else 2)
        mirror = self.values.get("mirror", False)
        if not isinstance(mirror, bool):
            raise ValueError(f"{self.where}: mirror={mirror!r} must be true or false")
        return Mark(
            self.where,
            (int(offset[0]), int(offset[1])),
            mask=mask,
            shape=shapes[0],
            points=points,
            radius=self._number("radius", 0.0),
            rotation=self._number("rotation", 0.0),
            scale=self._number("scale", 1.0),
            mirror=mirror,
        )

    def _points(self, key: str, count: int) -> tuple[tuple[float, ...], ...]:
        rows = self.values[key]
        if not isinstance(rows, list) or not rows:
            raise ValueError(f"{self.where}: {key} must be a list of points, not empty")
        return tuple(self._numbers(key, row, count) for row in rows)

    def _number(self, key: str, default: float) -> float:
        return self._numbers(key, [self.values.get(key, default)], 1)[0]

    def _numbers(self, key: str, values: Any, count: int) -> tuple[float, ...]:
        good = isinstance(values, list) and len(values) == count
        if not good or not all(_is_number(value) for value in values):
            form = {1: "a number", 2: "[row, column]", 3: "[row, column, radius]"}[count]
            shown = values[0] if isinstance(values, list) and count == len(values) == 1 else values
            raise ValueError(f"{self.where}: {key} has {shown!r}; it must be {form}")
        return tuple(float(value) for value in values)


def _is_number(value: Any) -> bool:
    kind = isinstance(value, (int, float)) and not isinstance(value, bool)
    return kind and abs(value) < 1e9  # NaN is not
