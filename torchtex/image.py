"""Images: pictures read and written, checked and resized.

An image is a (c, h, w) tensor, usually in [0, 1]; a mask is (h, w) and True where a pixel counts.
The numbers are the file's own, normally sRGB; colour profiles are ignored.
"""

import json
import math
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.codecs import decode, decoding, jpeg, opened, png, reason, tiff

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")  # what `save` writes


@dataclass(frozen=True)
class Picture:
    """An image, and where it counts; `mask` is None when all of it does.

    Example:
        >>> Picture(torch.zeros(3, 4, 5)).mask is None
        True
    """

    image: Float[Tensor, "c h w"]
    mask: Bool[Tensor, "h w"] | None = None


def load(path: str | os.PathLike[str], *, alpha: bool = True, name: str = "path") -> Picture:
    """A picture file as float32: one channel if it is grey, else three.

    PNG, JPEG, WebP, TIFF, GIF and BMP of 1, 8 or 16 bits are scaled to [0, 1]; palettes and CMYK
    become RGB. A float TIFF of one channel keeps its values. 16 bits are kept for grey and RGB,
    with or without alpha; a TIFF whose colours are premultiplied by alpha is read with 8.
    The picture is turned as its EXIF orientation says.

    Args:
        alpha: transparency becomes the mask, True where alpha > 0.5, and None if that is
            everywhere; otherwise it is dropped. Colours are never multiplied by it.
        name: what an error calls `path`.

    Raises:
        ValueError: the file is missing, unreadable, damaged, no picture, animated, larger than
            Pillow's limit (about 89 million pixels), holds NaN or infinities, or its alpha
            leaves no pixel.

    Example:
        >>> from torchtex import data
        >>> load(data.path("wood")).image.shape
        torch.Size([3, 128, 128])
    """
    where = _where(name, path)
    values, opaque = decode(read_bytes(path, name=name), where)
    if not np.isfinite(values).all():
        count = int((~np.isfinite(values)).any(-1).sum())
        raise ValueError(f"{where} holds NaN or infinity at {count} pixels; replace them")
    image = torch.from_numpy(values).permute(2, 0, 1).contiguous()
    if not alpha or opaque is None or opaque.all():
        return Picture(image)
    if not opaque.any():
        raise ValueError(f"{where} is transparent everywhere; give it some opaque pixels")
    return Picture(image, torch.from_numpy(opaque))


def load_mask(
    path: str | os.PathLike[str], size: tuple[int, int], *, name: str = "mask"
) -> Bool[Tensor, "h w"]:
    """A mask from a picture file: True where it is lighter than mid-grey. Alpha is ignored.

    Args:
        size: (rows, columns) that the mask must have.
        name: what an error calls `path`.

    Raises:
        ValueError: as `load`; or the size differs, or no pixel is True.

    Example:
        >>> from torchtex import data
        >>> load_mask(data.path("bricks"), (128, 128)).shape
        torch.Size([128, 128])
    """
    where = _where(name, path)
    mask = luminance(load(path, alpha=False, name=name).image) > 0.5
    if tuple(mask.shape) != tuple(size):
        raise ValueError(
            f"{where} has {mask.shape[0]} x {mask.shape[1]} pixels (rows x columns), its picture "
            f"{size[0]} x {size[1]}; make them the same size"
        )
    if not mask.any():
        raise ValueError(f"{where} is empty: no pixel is white; paint what shall count white")
    return mask


def save(
    path: str | os.PathLike[str],
    image: Float[Tensor, "c h w"],
    *,
    bits: int = 8,
    metadata: Mapping[str, str] | None = None,
    name: str = "path",
) -> None:
    """Write a PNG, JPEG or TIFF, as the name's ending says, whole or not at all.

    Values are clipped to [0, 1] and rounded. The file is written under a temporary name in the
    same folder and then renamed, so that nothing half-written is ever seen or left.

    Args:
        image: 1 channel (grey), 2 (grey, alpha), 3 (RGB) or 4 (RGB, alpha).
        bits: per channel, 8 or 16; PNG holds 16 for any channels, TIFF for grey, JPEG never.
        metadata: becomes PNG text chunks, or one JSON text in a JPEG comment or the TIFF
            description; `read_metadata` reads it back.
        name: what an error calls `path`.

    Raises:
        ValueError: an unknown ending, a folder that is missing or not writable, NaN or infinity
            in `image`, channels or `bits` that the format cannot hold, a key that PNG does not
            allow, or a failed write.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(f"{folder}/grey.png", torch.full((1, 4, 5), 0.5), bits=16)
        ...     round(load(f"{folder}/grey.png").image.mean().item(), 4)
        0.5
    """
    check_writable(path, suffixes=SUFFIXES, name=name)
    check_image(image, "image")
    kind = {".p": "PNG", ".j": "JPEG", ".t": "TIFF"}[Path(path).suffix.lower()[:2]]
    channels, text = image.shape[0], dict(metadata or {})
    if channels not in ((1, 3) if kind == "JPEG" else (1, 2, 3, 4)):
        raise ValueError(
            f"image has {channels} channels, which a {kind} cannot hold; "
            "save 1 (grey) or 3 (RGB) of them at a time"
        )
    if bits not in (8, 16):
        raise ValueError(f"bits={bits} must be 8 or 16")
    if bits == 16 and kind != "PNG" and not (kind == "TIFF" and channels == 1):
        raise ValueError(f"bits=16 with {channels} channels cannot be saved as {kind}; use .png")
    for key in text if kind == "PNG" else ():
        if not (key.isascii() and key.isprintable() and key == key.strip() and 0 < len(key) < 80):
            raise ValueError(f"metadata: PNG allows keys of 1 to 79 ASCII characters, not {key!r}")
    if kind == "JPEG" and len(json.dumps(text)) > 65000:
        raise ValueError("metadata is too long for a JPEG (64 KB); save as .png")
    levels = image.detach().cpu().double().clamp(0, 1) * (2**bits - 1)
    pixels = levels.round().permute(1, 2, 0).numpy().astype(np.uint8 if bits == 8 else np.uint16)
    encode = {"PNG": png, "JPEG": jpeg, "TIFF": tiff}[kind]
    with atomic_write(path, name=name) as partial:
        partial.write_bytes(encode(pixels, text))


def read_metadata(path: str | os.PathLike[str], *, name: str = "path") -> dict[str, str]:
    """The texts that `save` wrote, and any other text chunks of a PNG; empty if there are none.

    Raises:
        ValueError: the file is missing, unreadable or no picture.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(f"{folder}/grey.png", torch.zeros(1, 4, 5), metadata={"seed": "7"})
        ...     read_metadata(f"{folder}/grey.png")
        {'seed': '7'}
    """
    where = _where(name, path)
    data = read_bytes(path, name=name)
    with decoding(where):
        image = opened(data)
        if image.format == "PNG":
            return {str(key): str(value) for key, value in image.text.items()}
        text = image.info.get("comment") if image.format != "TIFF" else image.tag_v2.get(270)
    try:
        found = json.loads(text or "{}")
    except ValueError:
        return {}
    return {key: str(value) for key, value in found.items()} if isinstance(found, dict) else {}


def read_bytes(path: str | os.PathLike[str], *, name: str = "path") -> bytes:
    """All of a file.

    Raises:
        ValueError: it is missing, a folder, or cannot be read.

    Example:
        >>> read_bytes("missing.png", name="exemplar")
        Traceback (most recent call last):
        ValueError: exemplar='missing.png': there is no such file; check the name
    """
    where = _where(name, path)
    if Path(path).is_dir():
        raise ValueError(f"{where} is a folder; name a picture in it")
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise ValueError(f"{where}: there is no such file; check the name") from None
    except OSError as error:
        raise ValueError(f"{where} cannot be read: {reason(error)}") from error


@contextmanager
def atomic_write(path: str | os.PathLike[str], *, name: str = "path") -> Iterator[Path]:
    """A temporary file beside `path`, to be written in the block and renamed to `path` after it.

    It ends like `path`, and is removed if the block raises anything, Ctrl-C included; `path` is
    then as it was. A symbolic link stays one: the file that it points to is replaced.

    Raises:
        ValueError: as `check_writable`, or writing failed (the disk is full, say).

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with atomic_write(f"{folder}/notes.json") as partial:
        ...         _ = partial.write_text("{}")
        ...     [file.name for file in Path(folder).iterdir()]
        ['notes.json']
    """
    check_writable(path, name=name)
    target = Path(os.path.realpath(path))
    partial = target.with_name(f".torchtex-{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        yield partial
        os.replace(partial, target)
    except OSError as error:
        raise ValueError(f"{_where(name, path)} was not written: {reason(error)}") from error
    finally:
        partial.unlink(missing_ok=True)


def check_writable(
    path: str | os.PathLike[str], *, suffixes: Sequence[str] = (), name: str = "path"
) -> None:
    """Refuse a path that cannot be written, before any long work. Nothing is created.

    Args:
        suffixes: endings allowed, such as `SUFFIXES` for a picture; none given means any.
        name: what an error calls `path`.

    Raises:
        ValueError: the ending is not allowed, the folder is missing or not writable, or `path`
            is there and is no ordinary file.

    Example:
        >>> check_writable("texture.png", suffixes=SUFFIXES)
        >>> check_writable("texture.psd", suffixes=SUFFIXES)
        Traceback (most recent call last):
        ValueError: path='texture.psd' must end in .png, .jpg, .jpeg, .tif or .tiff
    """
    where = _where(name, path)
    if suffixes and Path(path).suffix.lower() not in suffixes:
        *most, last = suffixes
        raise ValueError(f"{where} must end in {' or '.join([', '.join(most), last][not most :])}")
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        raise ValueError(f"{where} is no ordinary file; choose another name")
    if not target.parent.is_dir():
        raise ValueError(f"{where}: there is no folder {str(target.parent)!r}; create it first")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise ValueError(f"{where}: the folder is not writable; choose another")


def check_image(image: Tensor, name: str = "image") -> None:
    """Refuse what is no image: (c, h, w), floating, not empty, all values finite.

    Args:
        name: what an error calls `image`.

    Raises:
        ValueError: in one sentence, what is wrong.
        TypeError: `image` is no floating tensor.

    Example:
        >>> check_image(torch.zeros(3, 4, 5))
        >>> check_image(torch.zeros(4, 5), "exemplar")
        Traceback (most recent call last):
        ValueError: exemplar has shape (4, 5); an image is (channels, rows, columns)
    """
    if not isinstance(image, Tensor):
        raise TypeError(f"{name} is a {type(image).__name__}; pass a (c, h, w) tensor")
    if image.ndim != 3:
        raise ValueError(
            f"{name} has shape {tuple(image.shape)}; an image is (channels, rows, columns)"
        )
    if not image.is_floating_point():
        raise TypeError(f"{name} is {image.dtype}; convert it to floating point in [0, 1]")
    if image.numel() == 0:
        raise ValueError(f"{name} has shape {tuple(image.shape)} and so no pixels")
    if not image.isfinite().all():
        count = int((~image.isfinite()).any(0).sum())
        raise ValueError(f"{name} holds NaN or infinity at {count} pixels; replace them")


def luminance(image: Float[Tensor, "c h w"]) -> Float[Tensor, "h w"]:
    """Lightness of each pixel: Rec. 601 of RGB, else the mean of the channels.

    Example:
        >>> luminance(torch.ones(3, 4, 5)).shape
        torch.Size([4, 5])
    """
    if image.shape[0] != 3:
        return image.mean(0)
    from kornia.color import rgb_to_grayscale

    grey: Tensor = rgb_to_grayscale(image)[0]
    return grey


def resize(
    image: Float[Tensor, "c h w"], size: tuple[int, int], *, antialias: bool = True
) -> Float[Tensor, "c y x"]:
    """The image at another size, in rows and columns: bicubic, and differentiable.

    Cubic splines overshoot a little beside sharp edges; the map stays linear, so nothing is
    clipped. Every constant image stays constant.

    Args:
        size: (rows, columns) wanted.
        antialias: where the image shrinks, the cubic is widened to a low-pass filter, so that
            fine detail fades instead of turning into false patterns.

    Raises:
        ValueError: `size` is not at least 1 x 1.

    Source: Keys 1981, cubic convolution, a = -1/2 with `antialias` and -3/4 without.

    Example:
        >>> resize(torch.ones(3, 8, 8), (4, 6)).shape
        torch.Size([3, 4, 6])
    """
    if min(size) < 1:
        raise ValueError(f"size={tuple(size)} must be at least 1 x 1 pixels")
    if tuple(image.shape[1:]) == tuple(size):
        return image
    return F.interpolate(image[None], size=size, mode="bicubic", antialias=antialias)[0]


def pyramid(image: Float[Tensor, "c h w"], scales: Sequence[float]) -> list[Tensor]:
    """The image at each scale, every one resized from the whole image, in the order given.

    Args:
        scales: share of rows and of columns kept, above 0; 1 is the image itself. Coarse levels
            come first by custom. Sizes are rounded, to at least one pixel.

    Raises:
        ValueError: a scale is not a positive number.

    Example:
        >>> [tuple(level.shape) for level in pyramid(torch.ones(3, 10, 8), (0.25, 0.5, 1.0))]
        [(3, 3, 2), (3, 5, 4), (3, 10, 8)]
    """
    if not all(scale > 0 and math.isfinite(scale) for scale in scales):
        raise ValueError(f"scales={tuple(scales)} must all be above 0")
    _, h, w = image.shape
    sizes = [(max(1, int(h * s + 0.5)), max(1, int(w * s + 0.5))) for s in scales]
    return [resize(image, size) for size in sizes]


def _where(name: str, path: str | os.PathLike[str]) -> str:
    return f"{name}={os.fspath(path)!r}"
