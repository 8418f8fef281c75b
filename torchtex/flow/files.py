"""Flow fields in files: numpy arrays and Middlebury's .flo, and drawn lines as JSON."""

import json
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.flow.fields import Given, check_fields
from torchtex.image import atomic_write, check_writable

FLOW_SUFFIXES = (".npy", ".npz", ".flo")
_MAGIC = 202021.25
_UNKNOWN = 1e9  # components from here on mean that the flow is not known


def load_flow(path: str | os.PathLike[str], *, loop: bool = False, name: str = "flow") -> Given:
    """Flow fields from a file, as float32 or float64.

    - `.npy`: (2, h, w), or (n, 2, h, w) with one field per frame; (row, column) displacements.
    - `.npz`: the same, under the name `flow` or as the only array.
    - `.flo`: Middlebury's format, one field; its u is the column, its v the row displacement.

    Args:
        loop: after the last field comes the first.
        name: what an error calls `path`.

    Raises:
        ValueError: in one sentence: no such file, another ending, damaged or cut short, unknown
            flow, or what `check_fields` refuses.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_flow(f"{folder}/drift.flo", torch.ones(2, 4, 5))
        ...     load_flow(f"{folder}/drift.flo").fields.shape
        torch.Size([2, 4, 5])
    """
    where = f"{name}={os.fspath(path)!r}"
    if _suffix(path) not in FLOW_SUFFIXES:
        raise ValueError(f"{where} must end in .npy, .npz or .flo")
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise ValueError(f"{where}: there is no such file") from None
    except OSError as error:
        raise ValueError(f"{where} cannot be read: {error.strerror or error}") from None
    fields = _from_flo(data, where) if _suffix(path) == ".flo" else _from_numpy(path, where)
    check_fields(fields, where)
    return Given(fields, loop)


def save_flow(
    path: str | os.PathLike[str], fields: Float[Tensor, "..."], *, name: str = "path"
) -> None:
    """Writes what `load_flow` reads. A `.flo` file holds one field, in float32.

    Args:
        fields: (2, h, w) or (n, 2, h, w).
        name: what an error calls `path`.

    Raises:
        ValueError: another ending, a folder that cannot be written, several fields for `.flo`,
            or what `check_fields` refuses.

    Example:
        >>> save_flow("drift.flo", torch.ones(3, 2, 4, 5))
        Traceback (most recent call last):
        ValueError: path='drift.flo' holds one field and there are 3; save them as .npy or .npz
    """
    where = f"{name}={os.fspath(path)!r}"
    check_writable(path, suffixes=FLOW_SUFFIXES, name=name)
    check_fields(fields)
    if _suffix(path) == ".flo" and fields.ndim == 4 and len(fields) > 1:
        raise ValueError(
            f"{where} holds one field and there are {len(fields)}; save them as .npy or .npz"
        )
    array = fields.detach().cpu().numpy()
    with atomic_write(path, name=name) as partial, open(partial, "wb") as file:
        if _suffix(path) == ".npy":
            np.save(file, array)
        elif _suffix(path) == ".npz":
            np.savez_compressed(file, flow=array)
        else:
            file.write(_to_flo(array.reshape(array.shape[-3:])))


def load_strokes(
    path: str | os.PathLike[str], *, name: str = "file"
) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Lines for `Strokes` from a JSON file: a list of lists of [row, column] points.

    Args:
        name: what an error calls `path`.

    Raises:
        ValueError: no such file, no JSON, or other JSON.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(f"{folder}/up.json").write_text("[[[0.9, 0.5], [0.1, 0.5]]]")
        ...     load_strokes(f"{folder}/up.json")
        (((0.9, 0.5), (0.1, 0.5)),)
    """
    where = f"{name}={os.fspath(path)!r}"
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{where}: there is no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{where} cannot be read as JSON: {error}") from None
    lines = found.get("strokes") if isinstance(found, dict) else found
    try:
        if not isinstance(lines, list):
            raise TypeError
        return tuple(tuple((float(row), float(column)) for row, column in line) for line in lines)
    except (TypeError, ValueError):
        raise ValueError(
            f"{where} must hold lines, each a list of [row, column] points such as "
            "[[[0.9, 0.5], [0.1, 0.5]]]"
        ) from None


def _suffix(path: str | os.PathLike[str]) -> str:
    return Path(path).suffix.lower()


def _from_numpy(path: str | os.PathLike[str], where: str) -> Tensor:
    try:
        with open(path, "rb") as raw:
            array = np.load(raw, allow_pickle=False)
            if isinstance(array, np.lib.npyio.NpzFile):
                with array as pack:
                    if "flow" not in pack.files and len(pack.files) != 1:
                        names = ", ".join(pack.files) or "nothing"
                        raise ValueError(f"it holds {names}, and none of them is called flow")
                    array = pack["flow" if "flow" in pack.files else pack.files[0]]
        if array.dtype.kind not in "fiu":
            raise ValueError(f"its numbers are {array.dtype}")
    except Exception as error:  # numpy raises many types for damaged files
        raise ValueError(
            f"{where} is damaged or no flow ({error}); save (2, rows, columns) numbers"
        ) from None
    wide = array.dtype.kind != "f" or array.dtype.itemsize > 4
    # native byte order, writable
    return torch.from_numpy(array.astype(np.float64 if wide else np.float32))


def _from_flo(data: bytes, where: str) -> Tensor:
    if len(data) < 12 or struct.unpack("<f", data[:4])[0] != _MAGIC:
        raise ValueError(f"{where} does not begin like a .flo file; export it again")
    width, height = struct.unpack("<ii", data[4:12])
    if width < 1 or height < 1:
        raise ValueError(f"{where} is {height} x {width} pixels; a flow needs at least one")
    if len(data) - 12 != 8 * width * height:
        raise ValueError(
            f"{where} holds {len(data) - 12} bytes for {height} x {width} pixels of 8; it is cut "
            "short or damaged, export it again"
        )
    values = np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2)
    unknown = int((np.abs(values) >= _UNKNOWN).any(-1).sum())
    if unknown:
        raise ValueError(f"{where} does not know the flow of {unknown} pixels; fill them in")
    return torch.from_numpy(values[..., ::-1].transpose(2, 0, 1).astype(np.float32))


def _to_flo(array: Any) -> bytes:
    _, height, width = array.shape
    pixels = array[::-1].transpose(1, 2, 0).astype("<f4")
    return struct.pack("<fii", _MAGIC, width, height) + pixels.tobytes()
