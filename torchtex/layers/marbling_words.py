"""Marbling operations in words, for a command line, and in JSON files."""

import difflib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from torchtex.layers.tines import Comb, Operation, Tine, Wave, plain
from torchtex.layers.whirls import Circle, Drop, Vortex

_KINDS: dict[str, type] = {
    "tine": Tine, "comb": Comb, "wave": Wave, "circle": Circle, "vortex": Vortex, "drop": Drop,
}  # fmt: skip


def parse_operation(text: str, *, name: str = "op") -> Operation:
    """An operation in words: NAME, or NAME: and values in the order below or as name=value.

    | name | what may be given, and what it is if left out |
    |---|---|
    | tine | angle=90, shift=0.25, width=0.06, row=0.5, column=0.5 |
    | comb | tines=8, angle=90, shift=0.1, width=0.03, row=0.5, column=0.5 |
    | wave | amplitude=0.05, rows=0, columns=3, phase=0 |
    | circle | row=0.5, column=0.5, radius=0.25, shift=0.25, width=0.06 |
    | vortex | row=0.5, column=0.5, turn=180, radius=0.15 |
    | drop | row=0.5, column=0.5, radius=0.1, color (#rrggbb; the texture itself if left out) |

    Args:
        name: what an error calls `text`.

    Raises:
        ValueError: in one sentence, what is wrong and what is known.

    Example:
        >>> parse_operation("tine:45,shift=0.1").angle
        45.0
        >>> parse_operation("tyne")
        Traceback (most recent call last):
        ValueError: op='tyne' names no operation; did you mean tine?
    """
    word, _, rest = text.strip().partition(":")
    where = f"{name}={text!r}"
    known = [field.name for field in fields(_kind(word, where))]
    values: dict[str, Any] = {}
    named = False
    for part in (part.strip() for part in rest.split(",") if part.strip()):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals:
            if named or len(values) >= len(known):
                raise ValueError(f"{where} has no place for {part!r}; write name={part}")
            key, value = known[len(values)], part
        named = named or bool(equals)
        if key in values:
            raise ValueError(f"{where} gives {key} twice; give it once")
        values[key] = value if key == "color" else _number(value, key, where)
    return _built(word, values, where)


def load_operations(path: str | Path, *, name: str = "operations") -> list[Operation]:
    """The operations of a JSON file: [{"operation": "tine", "angle": 45, ...}, ...].

    Args:
        name: what an error calls `path`.

    Raises:
        ValueError: in one sentence, what is wrong with the file.

    Example:
        >>> load_operations("missing.json")
        Traceback (most recent call last):
        ValueError: ...
    """
    where = f"{name}={str(path)!r}"
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{where} cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where} is not JSON ({error}); write a list of operations") from None
    if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
        raise ValueError(
            f'{where} is no list of operations; write [{{"operation": "tine", "angle": 45}}, ...]'
        )
    if not found:
        raise ValueError(f"{where} holds no operations; write at least one")
    return [_item(item, f"{where}, operation {number}") for number, item in enumerate(found, 1)]


def as_json(operation: Operation) -> dict[str, Any]:
    """An operation as an item of such a file.

    Example:
        >>> as_json(Wave(0.1))
        {'operation': 'wave', 'amplitude': 0.1, 'rows': 0.0, 'columns': 3.0, 'phase': 0.0}
    """
    word = next(word for word, kind in _KINDS.items() if isinstance(operation, kind))
    values: dict[str, Any] = {"operation": word}
    for field in fields(_KINDS[word]):
        value = getattr(operation, field.name)
        if isinstance(value, tuple):
            values[field.name] = list(value)
        elif value is not None:
            values[field.name] = value if field.name == "tines" else plain(value)
    return values


def with_channels(operation: Operation, channels: int) -> Operation:
    """The operation with its ink in grey where the image is grey.

    Example:
        >>> with_channels(Drop(color=(1.0, 1.0, 1.0)), 1).color
        (1.0,)
    """
    if channels == 1 and isinstance(operation, Drop) and len(operation.color or ()) == 3:
        red, green, blue = operation.color or ()
        return replace(operation, color=(round(0.299 * red + 0.587 * green + 0.114 * blue, 6),))
    return operation


def _item(item: Mapping[str, Any], where: str) -> Operation:
    values = dict(item)
    word = values.pop("operation", None)
    if not isinstance(word, str):
        raise ValueError(f'{where} has no name; write "operation": "tine", or another')
    for key, value in values.items():
        if key != "color" and (isinstance(value, bool) or not isinstance(value, (int, float))):
            raise ValueError(f"{where}: {key} has {value!r}; it must be a number")
    return _built(word, values, where)


def _built(word: str, values: dict[str, Any], where: str) -> Operation:
    kind = _kind(word, where)
    known = [field.name for field in fields(kind)]
    for key, value in values.items():
        if key not in known:
            raise ValueError(f"{where} has no {key!r}; known are {', '.join(known)}")
        if key == "color":
            values[key] = _color(value, where)
        elif key == "tines":
            if value != int(value):
                raise ValueError(f"{where}: tines={value} must be whole")
            values[key] = int(value)
        else:
            values[key] = float(value)
    try:
        made: Operation = kind(**values)
        return made
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _kind(word: str, where: str) -> type:
    if word in _KINDS:
        return _KINDS[word]
    close = difflib.get_close_matches(word, _KINDS, n=1)
    hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(_KINDS)}"
    raise ValueError(f"{where} names no operation; {hint}")


def _number(text: str, key: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{where}: {key}={text} must be a number")
    return value


def _color(value: Any, where: str) -> tuple[float, ...] | None:
    if value is None:
        return None
    if isinstance(value, str) and re.fullmatch(r"#[0-9a-fA-F]{6}", value):
        return tuple(int(value[i : i + 2], 16) / 255 for i in (1, 3, 5))
    numbers = isinstance(value, list) and value and all(type(v) in (int, float) for v in value)
    if numbers:
        return tuple(float(v) for v in value)
    raise ValueError(f"{where}: color={value!r} must be #rrggbb, or in a file a list of values")
