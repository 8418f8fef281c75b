"""Flows in words, for a command line."""

import difflib
import inspect
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torchtex.flow.fields import Flow, Summed, Uniform, is_periodic
from torchtex.flow.files import FLOW_SUFFIXES, load_flow, load_strokes
from torchtex.flow.fluids import DoubleGyre, StableFluid
from torchtex.flow.formulas import Rotation, Saddle, Shear, Sink, Source, Wave
from torchtex.flow.strokes import Strokes
from torchtex.flow.vortices import Vortices, vortex_pair


def parse_flow(text: str, *, name: str = "flow") -> Flow:
    """A flow in words.

        FLOW  = TERM, or TERM+TERM+... for flows that add up
        TERM  = NAME, or NAME:ARGUMENTS, or the path of a .npy, .npz or .flo file (`load_flow`)
        ARGUMENTS = values in the order below, and then name=value, separated by commas

    | name | arguments and what they are if left out |
    |---|---|
    | uniform | row=0, column=0 |
    | shear | speed=2, angle=0, periodic |
    | rotation | degrees=2, row=0.5, column=0.5 |
    | vortex | strength=3, radius=0.2, row=0.5, column=0.5, periodic |
    | pair | strength=3, radius=0.12, distance=0.4, periodic |
    | source, sink | speed=1.5, core=0.15, row=0.5, column=0.5, periodic |
    | saddle | speed=2, angle=0, row=0.5, column=0.5, periodic |
    | wave | amplitude=1.5, rows=0, columns=2, period=24 |
    | gyre | speed=2.5, swing=0.25, period=48, periodic |
    | fluid | seed=0, speed=1.5, scale=0.1, stir=0.15, viscosity=0.2, resolution=64, periodic |
    | strokes | file, speed=2, width (thin plates if left out), smoothing=0.1, periodic |
    | file | path, loop |

    `periodic` and `loop` are off unless named, alone or as periodic=yes. `strokes` reads JSON: a
    list of lines, each a list of [row, column] points, shares of height and width; or an object
    with such a list as "strokes". `file:PATH,loop` repeats the fields of a file.

    Args:
        name: what an error calls `text`.

    Raises:
        ValueError: in one sentence, what is wrong and what is known.

    Example:
        >>> parse_flow("rotation:2")
        Rotation(degrees=2.0, center=(0.5, 0.5))
        >>> parse_flow("uniform:0,2+sink:speed=1,periodic").flows[1]
        Sink(speed=1.0, center=(0.5, 0.5), core=0.15, periodic=True)
        >>> parse_flow("vortx:3")
        Traceback (most recent call last):
        ValueError: flow='vortx:3' names no flow; did you mean vortex?
    """
    flows = tuple(_parse_term(term, name) for term in _terms(text))
    return flows[0] if len(flows) == 1 else Summed(flows)


def untiled(text: str, *, name: str = "flow") -> list[str]:
    """Sentences on the terms of a flow that are no tiles, each with what to write instead.

    Of fields from files nobody knows, and who writes periodic=no knows.

    Raises:
        ValueError: as `parse_flow`.

    Example:
        >>> untiled("uniform:0,2+sink:1.5")
        ["flow='sink:1.5' is no tile, so motion jumps where tiles meet; write sink:1.5,periodic"]
    """
    found = []
    for term in _terms(text):
        word, _, rest = term.partition(":")
        if is_periodic(_parse_term(term, name)) is False and "periodic" not in rest:
            instead = _TILED.get(word, f"write {word}:{rest}{',' * bool(rest)}periodic")
            found.append(f"{name}={term!r} is no tile, so motion jumps where tiles meet; {instead}")
    return found


def _terms(text: str) -> list[str]:
    terms = re.split(rf"\+(?=(?:{'|'.join(_BUILDERS)})(?:[:+]|$))", text.strip())
    return [term.strip() for term in terms]


def _parse_term(term: str, name: str) -> Flow:
    word, _, rest = term.partition(":")
    where = f"{name}={term!r}"
    if word not in _BUILDERS:
        if Path(term).suffix.lower() in FLOW_SUFFIXES:
            return load_flow(term, name=name)
        close = difflib.get_close_matches(word, _BUILDERS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(_BUILDERS)}"
        raise ValueError(
            f"{where} names no flow; {hint}"
            + ("" if close else " and paths that end in .npy, .npz or .flo")
        )
    build = _BUILDERS[word]
    arguments = _parse_arguments(rest, inspect.signature(build).parameters, where)
    try:
        return build(**arguments)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _parse_arguments(
    text: str, known: Mapping[str, inspect.Parameter], where: str
) -> dict[str, Any]:
    """Values by name, of the types that the builder states."""
    found: dict[str, Any] = {}
    order = [key for key, parameter in known.items() if parameter.annotation is not bool]
    named = False
    for part in (part.strip() for part in text.split(",") if part.strip()):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals and part in known and known[part].annotation is bool:
            key, value = part, "yes"
        elif not equals:
            if named or len(found) >= len(order):
                raise ValueError(f"{where} has no place for {part!r}; write name={part}")
            key, value = order[len(found)], part
        named = named or bool(equals) or value == "yes"
        if key not in known:
            raise ValueError(f"{where} has no argument {key!r}; known are {', '.join(known)}")
        if key in found:
            raise ValueError(f"{where} gives {key} twice; give it once")
        found[key] = _value(value, known[key].annotation, key, where)
    for key, parameter in known.items():
        if key not in found and parameter.default is parameter.empty:
            raise ValueError(f"{where} needs {key}; write it after the colon")
    return found


def _value(text: str, kind: Any, key: str, where: str) -> Any:
    if kind is bool:
        if text.lower() in ("yes", "true", "1", "on"):
            return True
        if text.lower() in ("no", "false", "0", "off"):
            return False
        raise ValueError(f"{where}: {key}={text} must be yes or no")
    if kind is str:
        return text
    try:
        return int(text) if kind is int else float(text)
    except ValueError:
        word = "a whole number" if kind is int else "a number"
        raise ValueError(f"{where}: {key}={text} must be {word}") from None


def _uniform(row: float = 0.0, column: float = 0.0) -> Flow:
    return Uniform((row, column))


def _rotation(degrees: float = 2.0, row: float = 0.5, column: float = 0.5) -> Flow:
    return Rotation(degrees, (row, column))


def _vortex(
    strength: float = 3.0,
    radius: float = 0.2,
    row: float = 0.5,
    column: float = 0.5,
    periodic: bool = False,
) -> Flow:
    return Vortices((strength,), ((row, column),), radius, periodic)


def _source(
    speed: float = 1.5,
    core: float = 0.15,
    row: float = 0.5,
    column: float = 0.5,
    periodic: bool = False,
) -> Flow:
    return Source(speed, (row, column), core, periodic)


def _sink(
    speed: float = 1.5,
    core: float = 0.15,
    row: float = 0.5,
    column: float = 0.5,
    periodic: bool = False,
) -> Flow:
    return Sink(speed, (row, column), core, periodic)


def _saddle(
    speed: float = 2.0,
    angle: float = 0.0,
    row: float = 0.5,
    column: float = 0.5,
    periodic: bool = False,
) -> Flow:
    return Saddle(speed, (row, column), angle, periodic)


def _wave(
    amplitude: float = 1.5, rows: float = 0.0, columns: float = 2.0, period: float = 24.0
) -> Flow:
    return Wave(amplitude, (rows, columns), period)


def _fluid(
    seed: int = 0,
    speed: float = 1.5,
    scale: float = 0.1,
    stir: float = 0.15,
    viscosity: float = 0.2,
    resolution: int = 64,
    periodic: bool = False,
) -> Flow:
    return StableFluid(seed, speed, scale, stir, viscosity, periodic, resolution)


def _strokes(
    file: str,
    speed: float = 2.0,
    width: float | None = None,
    smoothing: float = 0.1,
    periodic: bool = False,
) -> Flow:
    return Strokes(load_strokes(file), speed, width, smoothing, periodic)


def _file(path: str, loop: bool = False) -> Flow:
    return load_flow(path, loop=loop, name="path")


_BUILDERS: dict[str, Callable[..., Flow]] = {
    "uniform": _uniform, "shear": Shear, "rotation": _rotation, "vortex": _vortex,
    "pair": vortex_pair, "source": _source, "sink": _sink, "saddle": _saddle, "wave": _wave,
    "gyre": DoubleGyre, "fluid": _fluid, "strokes": _strokes, "file": _file,
}  # fmt: skip

_TILED = {
    "rotation": "a vortex with periodic turns too",
    "wave": "give it whole rows and columns",
}
