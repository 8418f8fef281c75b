"""Volumes as files: .npy, .nrrd, .vti, .zarr and folders of slices, read and written.

A volume is a (c, d, h, w) tensor in [0, 1]. Files hold it with the channels innermost, as pictures
do, but for .npy, which holds the tensor as it is.
"""

import json
import os
import re
import shutil
import uuid
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchtex import image as images
from torchtex.extras import needed
from torchtex.volumes.formats import VTI_TAIL, nrrd_head, read_nrrd, read_vti, vti_head

SUFFIXES = (".npy", ".nrrd", ".vti", ".zarr")
"""Endings of volume files; a name without an ending is a folder of slices."""

_TYPES: dict[int, np.dtype[Any]] = {8: np.dtype("<u1"), 16: np.dtype("<u2"), 32: np.dtype("<f4")}


def check_volume(volume: Tensor, name: str = "volume") -> None:
    """Refuses what is no volume: (c, d, h, w), floating, not empty, all values finite.

    Raises:
        ValueError: in one sentence, what is wrong.

    Example:
        >>> check_volume(torch.zeros(3, 4, 5))
        Traceback (most recent call last):
        ValueError: volume has shape (3, 4, 5); a volume is (channels, depth, rows, columns)
    """
    if volume.ndim != 4 or not volume.numel():
        raise ValueError(
            f"{name} has shape {tuple(volume.shape)}; a volume is (channels, depth, rows, columns)"
        )
    if not volume.is_floating_point():
        raise ValueError(f"{name} is {volume.dtype}; convert it to floating point in [0, 1]")
    if not bool(volume.isfinite().all()):
        raise ValueError(f"{name} holds NaN or infinity; replace them")


def check_volume_path(
    path: str | os.PathLike[str], *, bits: int = 8, channels: int = 3, name: str = "path"
) -> None:
    """Refuses, before any work, a name that a volume cannot be written to.

    Args:
        bits: 8 or 16 per value, or 32 for floats, which pictures cannot hold.
        channels: of the volume; slices hold 1 or 3.
        name: what an error calls `path`.

    A folder may be replaced only where it holds nothing but slices, or, under a name that ends in
    .zarr, nothing but one array.

    Raises:
        ValueError: in one sentence, what is wrong.

    Example:
        >>> check_volume_path("solid.obj")
        Traceback (most recent call last):
        ValueError: path='solid.obj' must end in .npy, .nrrd, .vti or .zarr, or have no ending ...
    """
    suffix, where = Path(path).suffix.lower(), f"{name}={str(path)!r}"
    if suffix not in ("", *SUFFIXES):
        raise ValueError(
            f"{where} must end in .npy, .nrrd, .vti or .zarr, or have no ending for a folder of "
            "slices"
        )
    if bits not in _TYPES:
        raise ValueError(f"bits={bits} must be 8, 16 or 32 (floats)")
    if suffix == "" and (bits == 32 or channels not in (1, 3)):
        raise ValueError(
            f"{where}: pictures hold 8 or 16 bits and 1 or 3 channels, not bits={bits} and "
            f"{channels} channels; name a .npy, .nrrd, .vti or .zarr"
        )
    if suffix in (".npy", ".nrrd", ".vti"):
        images.check_writable(path, name=name)
        return
    target = Path(path)
    if target.is_dir() and not _ours(target, suffix):
        raise ValueError(f"{where} is a folder that holds other things; name another one")
    if target.is_file():
        raise ValueError(f"{where} is a file; name a folder, or add an ending")
    images.check_writable(f"{os.path.realpath(target)}.new" if target.is_dir() else path, name=name)
    if suffix == ".zarr":
        needed("zarr", name)


def save_volume(
    path: str | os.PathLike[str],
    volume: Float[Tensor, "c d h w"],
    *,
    bits: int = 8,
    name: str = "path",
) -> None:
    """Writes a volume, whole or not at all, as the ending of the name says.

    No ending: a folder of pictures slice_0000.png, one for each step along the first axis.

    Args:
        volume: values are clipped to [0, 1] and rounded; with 32 bits they are kept as floats.
        bits: 8, 16 or 32 per value.
        name: what an error calls `path`.

    Raises:
        ValueError: as `check_volume` and `check_volume_path`, or writing failed.
        ImportError: .zarr without zarr.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_volume(f"{folder}/grey.nrrd", torch.full((1, 2, 3, 4), 0.2))
        ...     load_volume(f"{folder}/grey.nrrd").shape
        torch.Size([1, 2, 3, 4])
    """
    check_volume(volume)
    check_volume_path(path, bits=bits, channels=len(volume), name=name)
    suffix = Path(path).suffix.lower()
    if suffix == "":
        with _whole_folder(path, name) as partial:
            for number in range(volume.shape[1]):
                slice_path = partial / f"slice_{number:04d}.png"
                images.save(slice_path, volume[:, number], bits=bits, name=name)
        return
    values = _values(volume if suffix == ".npy" else volume.permute(1, 2, 3, 0), bits)
    if suffix == ".zarr":
        with _whole_folder(path, name) as partial:
            chunks = (*(min(64, n) for n in values.shape[:3]), values.shape[3])
            needed("zarr", name).open_array(
                str(partial), mode="w", shape=values.shape, chunks=chunks, dtype=values.dtype
            )[...] = values
        return
    with images.atomic_write(path, name=name) as partial, open(partial, "wb") as file:
        if suffix == ".npy":
            np.save(file, values)
        else:
            file.write(nrrd_head(values) if suffix == ".nrrd" else vti_head(values))
            file.write(values.data)
            file.write(VTI_TAIL if suffix == ".vti" else b"")


def load_volume(path: str | os.PathLike[str], *, name: str = "volume") -> Float[Tensor, "c d h w"]:
    """A volume as float32 in [0, 1]: whole numbers are scaled, floats kept.

    Args:
        path: .npy of (c, d, h, w), (d, h, w, c) or (d, h, w); .nrrd, raw or gzip; .vti, raw or
            base64, uncompressed; .zarr of (d, h, w, c) or (d, h, w); or a folder of pictures,
            the slices in order of their names.
        name: what an error calls `path`.

    Raises:
        ValueError: no such file, another kind of file, or one that is damaged.
        ImportError: .zarr without zarr.
    """
    where = f"{name}={str(path)!r}"
    suffix = Path(path).suffix.lower()
    if not Path(path).exists():
        raise ValueError(f"{where}: there is no such file; check the name")
    if Path(path).is_dir() and suffix != ".zarr":
        return _slices(Path(path), where, name)
    if suffix not in SUFFIXES:
        raise ValueError(f"{where} must end in .npy, .nrrd, .vti or .zarr, or be a folder")
    try:
        values = _READERS[suffix](Path(path))
        if values.ndim == 3:
            values = values[..., None]
        if values.ndim != 4 or not values.size or values.dtype.kind not in "uf":
            raise ValueError(f"it holds {values.dtype} of shape {values.shape}")
    except (
        OSError, KeyError, ValueError, TypeError, IndexError, EOFError, AttributeError,
        OverflowError, MemoryError, zlib.error, ParseError,
    ) as error:  # fmt: skip
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(
            f"{where} cannot be read as a volume ({reason}); "
            "give a .npy, .nrrd, .vti, .zarr or folder of slices"
        ) from None
    whole = np.iinfo(values.dtype).max if values.dtype.kind == "u" else None
    volume = torch.from_numpy(np.ascontiguousarray(values.transpose(3, 0, 1, 2), np.float32))
    volume = volume if whole is None else volume.div_(whole)
    check_volume(volume, where)
    return volume


def _values(volume: Tensor, bits: int) -> NDArray[Any]:
    pixels = volume.detach().cpu()
    if bits != 32:
        pixels = (pixels.clamp(0, 1) * (2**bits - 1)).round_()
    return np.ascontiguousarray(pixels.numpy().astype(_TYPES[bits]))


def _read_npy(path: Path) -> NDArray[Any]:
    values = np.load(path, allow_pickle=False)
    last = values.ndim == 4 and values.shape[3] <= 4 < values.shape[0]
    return values if last or values.ndim != 4 else values.transpose(1, 2, 3, 0)


def _read_zarr(path: Path) -> NDArray[Any]:
    zarr = needed("zarr", "volume")
    try:
        return np.asarray(zarr.open_array(str(path), mode="r")[...])
    except Exception as error:  # zarr has errors of its own, others in each version
        raise ValueError(str(error) or "no zarr array") from None


_READERS: dict[str, Callable[[Path], NDArray[Any]]] = {
    ".npy": _read_npy,
    ".nrrd": lambda path: read_nrrd(path.read_bytes()),
    ".vti": lambda path: read_vti(path.read_bytes()),
    ".zarr": _read_zarr,
}


def _slices(folder: Path, where: str, name: str) -> Tensor:
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in images.SUFFIXES)
    if not files:
        raise ValueError(f"{where} is a folder without pictures; name one that holds slices")
    pictures = [images.load(file, alpha=False, name=name).image for file in files]
    if len({picture.shape for picture in pictures}) > 1:
        raise ValueError(f"{where}: its slices differ in size or channels; make them the same")
    return torch.stack(pictures, 1)


def _ours(folder: Path, suffix: str) -> bool:
    """Whether a folder holds nothing but slices, or nothing but one zarr array under its ending.

    Only then it may be replaced.
    """
    found = {entry.relative_to(folder).as_posix() for entry in folder.rglob("*")}
    if suffix != ".zarr":
        return all(re.fullmatch(r"slice_\d{4,}\.png", file) for file in found)
    parts = r"\.zarray|\.zattrs|\d+([./]\d+)*"  # of the second version, and of the third
    if "zarr.json" in found:
        parts = r"zarr\.json|c|(c[./])?\d+([./]\d+)*"
    return all(re.fullmatch(parts, file) for file in found) and (
        not found or ".zarray" in found or _is_array(folder / "zarr.json")
    )


def _is_array(path: Path) -> bool:
    try:
        return bool(json.loads(path.read_text())["node_type"] == "array")
    except (OSError, ValueError, KeyError, TypeError):
        return False


@contextmanager
def _whole_folder(path: str | os.PathLike[str], name: str) -> Iterator[Path]:
    """A temporary folder beside `path`, to be filled in the block and renamed to it after."""
    target = Path(os.path.realpath(path))
    partial = target.with_name(f".torchtex-{uuid.uuid4().hex[:12]}{target.suffix}")
    old = partial.with_name(f"{partial.name}.old")
    try:
        partial.mkdir()
        yield partial
        if target.exists():
            target.rename(old)
        partial.rename(target)
    except OSError as error:
        raise ValueError(f"{name}={str(path)!r} was not written: {error.strerror}") from error
    finally:
        if old.exists() and not target.exists():  # Ctrl-C too
            old.rename(target)
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
