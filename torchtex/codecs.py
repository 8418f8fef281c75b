"""Pictures as bytes: decoded to arrays, with a sentence for bad files, and encoded."""

import json
import struct
import sys
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

READABLE = ("PNG", "JPEG", "WEBP", "TIFF", "GIF", "BMP")


def reason(error: BaseException) -> str:
    """What an error says, in a few words.

    Example:
        >>> reason(OSError(2, "no such file"))
        'no such file'
    """
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


@contextmanager
def decoding(where: str) -> Iterator[None]:
    """Turns whatever Pillow raises for a bad file, in the block, into one sentence.

    Raises:
        ValueError: that sentence, which begins with `where`.

    Example:
        >>> with decoding("exemplar='a.png'"):
        ...     opened(b"no picture")
        Traceback (most recent call last):
        ValueError: exemplar='a.png' is none of the pictures that can be read; export it as PNG
    """
    from PIL import Image, UnidentifiedImageError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            yield
        except UnidentifiedImageError:
            raise ValueError(
                f"{where} is none of the pictures that can be read ({', '.join(READABLE)}; "
                "no float colours); export it as PNG"
            ) from None
        except (Image.DecompressionBombError, Image.DecompressionBombWarning):
            raise ValueError(f"{where} has too many pixels; make it smaller first") from None
        except Exception as error:  # the decoders raise many types for damaged files
            raise ValueError(
                f"{where} is damaged or cut short ({reason(error)}); export it again"
            ) from error


def opened(data: bytes) -> Any:
    """A picture of Pillow, whose pixels are not decoded yet; for a `decoding` block.

    Example:
        >>> opened(png(np.zeros((4, 5, 3), np.uint8), {})).size
        (5, 4)
    """
    from PIL import Image

    return Image.open(BytesIO(data), formats=READABLE)


def decode(data: bytes, where: str) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Colours (h, w, c), scaled float32, and whether each pixel is opaque (h, w) or None.

    Args:
        where: what an error begins with.

    Raises:
        ValueError: it is no picture, damaged, animated, or of a kind that is not supported.

    Example:
        >>> decode(png(np.full((1, 1, 1), 51, np.uint8), {}), "picture")[0].tolist()
        [[[0.20000000298023224]]]
    """
    with decoding(where):
        image = opened(data)
        frames = getattr(image, "n_frames", 1)
        tags = image.tag_v2 if image.format == "TIFF" else {}
        depth = max(tags.get(258, (16,)))
    if frames > 1 and image.format != "MPO":  # MPO: a JPEG with its preview or depth
        raise ValueError(f"{where} holds {frames} frames; save one of them as a still picture")
    raw = _raw_mode(image)
    misread = depth > 8 and (tags.get(284) == 2 or (tags.get(262) == 0 and image.mode != "F"))
    if misread or (image.mode == "I" and image.format != "PNG"):  # planes, white as 0, 32 bits
        raise ValueError(f"{where} has a pixel format that is not supported; export it as PNG")
    key = image.info.get("transparency")
    with decoding(where):
        mode, top = image.mode, 2.0**depth - 1
        if mode == "F":
            top = 1.0
            levels = _turned(image)
        elif mode.startswith("I"):
            levels = _turned(image)
        elif raw.startswith(("RGB;16", "RGBA;16", "LA;16")):
            levels = _sixteen_bits(image, data, raw)
        else:
            mode, top, key = _plain_mode(image), 255.0, None
            levels = _turned(image.convert(mode) if mode != image.mode else image)
    levels = levels.reshape(*levels.shape[:2], -1)
    opaque = None if key is None else (levels != np.array(key)).any(-1)
    if levels.shape[2] in (2, 4):
        levels, opaque = levels[..., :-1], levels[..., -1] > top / 2
    return levels.astype(np.float32) / np.float32(top), opaque


def _turned(image: Any) -> NDArray[Any]:
    from PIL import ImageOps

    return np.array(ImageOps.exif_transpose(image))


def _raw_mode(image: Any) -> str:
    """How the file lays out a pixel, in Pillow's words, such as "RGB;16B"."""
    args = image.tile[0][3] if image.tile else ""
    return str(args if isinstance(args, str) or not args else args[0])


def _plain_mode(image: Any) -> str:
    if image.mode in ("1", "L", "LA", "La"):
        return "LA" if image.has_transparency_data else "L"
    return "RGBA" if image.has_transparency_data else "RGB"


def _sixteen_bits(image: Any, data: bytes, raw: str) -> NDArray[Any]:
    """Levels of 16-bit colours. Pillow keeps the high byte of each, so decode twice.

    Read with the other byte order, the byte that it takes for the high one is the low one. Grey
    with alpha has pixels of four bytes, which one reading as RGBA gives.
    """
    swapped = {"B": "L", "L": "B", "N": "B" if sys.byteorder == "little" else "L"}[raw[-1]]
    layout = "RGBA" if raw.startswith("LA") else raw[:-1] + swapped
    again = opened(data)
    again.tile = [
        getattr(type(tile), "_make", tuple)(
            (*tile[:3], layout if isinstance(tile[3], str) else (layout, *tile[3][1:]))
        )
        for tile in image.tile
    ]
    low = _turned(again).astype(np.int32)
    if raw.startswith("LA"):
        return low[..., 0::2] * 256 + low[..., 1::2]
    return _turned(image).astype(np.int32) * 256 + low


def png(pixels: NDArray[Any], text: dict[str, str]) -> bytes:
    """A PNG of (h, w, c) pixels of 8 or 16 bits, with text chunks.

    Example:
        >>> png(np.zeros((4, 5, 3), np.uint16), {"seed": "7"})[1:4]
        b'PNG'
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    if pixels.dtype == np.uint16:
        return _png16(pixels, text)
    info = PngInfo()
    for key, value in text.items():
        info.add_itxt(key, value)
    return _encoded(Image.fromarray(_squeezed(pixels)), "PNG", pnginfo=info)


def _png16(pixels: NDArray[Any], text: dict[str, str]) -> bytes:
    """PNG of 16 bits per channel, which Pillow writes for grey only."""
    h, w, c = pixels.shape
    rows = np.frombuffer(pixels.astype(">u2").tobytes(), np.uint8).reshape(h, w * c * 2)
    difference = rows.copy()
    difference[:, c * 2 :] -= rows[:, : -c * 2]  # filter 1: each byte less that of the pixel before
    lines = np.concatenate([np.ones((h, 1), np.uint8), difference], axis=1)
    colour_type = {1: 0, 2: 4, 3: 2, 4: 6}[c]
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", w, h, 16, colour_type, 0, 0, 0))]
    for key, value in text.items():
        chunks.append((b"iTXt", key.encode("ascii") + b"\0\0\0\0\0" + value.encode("utf-8")))
    chunks += [(b"IDAT", zlib.compress(lines.tobytes())), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


def jpeg(pixels: NDArray[Any], text: dict[str, str]) -> bytes:
    """A JPEG of high quality of (h, w, c) pixels of 8 bits, with texts as JSON in a comment.

    Example:
        >>> jpeg(np.zeros((4, 5, 3), np.uint8), {})[:2].hex()
        'ffd8'
    """
    from PIL import Image

    comment = json.dumps(text).encode() if text else b""
    image = Image.fromarray(_squeezed(pixels))
    return _encoded(image, "JPEG", quality=95, subsampling=0, comment=comment)


def tiff(pixels: NDArray[Any], text: dict[str, str]) -> bytes:
    """A TIFF of (h, w, c) pixels, grey ones also of 16 bits, with texts as JSON.

    Example:
        >>> tiff(np.zeros((4, 5, 1), np.uint16), {})[:2]
        b'II'
    """
    from PIL import Image

    options = {"description": json.dumps(text)} if text else {}
    return _encoded(Image.fromarray(_squeezed(pixels)), "TIFF", **options)


def _squeezed(pixels: NDArray[Any]) -> NDArray[Any]:
    return pixels[..., 0] if pixels.shape[2] == 1 else np.ascontiguousarray(pixels)


def _encoded(image: Any, kind: str, **options: Any) -> bytes:
    buffer = BytesIO()
    image.save(buffer, format=kind, **options)
    return buffer.getvalue()
