"""Two formats of volumes by hand: NRRD, and the ImageData of VTK. Bytes to arrays and back.

Arrays are (d, h, w, c): the channels vary fastest, then columns, rows and slices.
"""

import base64
import gzip
import math
import re
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

_NRRD = {
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("ushort", "unsigned short", "uint16", "uint16_t"), "u2"),
    "float": "f4",
    "double": "f8",
}
_VTI = {"UInt8": "u1", "UInt16": "u2", "Float32": "f4", "Float64": "f8"}


def nrrd_head(values: NDArray[Any]) -> bytes:
    """What stands before the values in a NRRD file.

    Example:
        >>> nrrd_head(np.zeros((2, 3, 4, 1), np.uint8)).splitlines()[3]
        b'sizes: 1 4 3 2'
    """
    d, h, w, c = values.shape
    kind = {1: "uint8", 2: "uint16", 4: "float"}[values.dtype.itemsize]
    lines = (
        "NRRD0004", f"type: {kind}", "dimension: 4", f"sizes: {c} {w} {h} {d}",
        f"kinds: {'RGB-color' if c == 3 else 'vector'} space space space",
        "endian: little", "encoding: raw",
    )  # fmt: skip
    return ("\n".join(lines) + "\n\n").encode()


def read_nrrd(content: bytes) -> NDArray[Any]:
    """The array in a NRRD file, raw or gzip; channels are found by the kinds of its axes.

    Raises:
        ValueError, KeyError: it is no such file.

    Example:
        >>> values = np.arange(24, dtype=np.uint8).reshape(2, 3, 4, 1)
        >>> bool((read_nrrd(nrrd_head(values) + values.tobytes()) == values).all())
        True
    """
    head, gap, data = content.partition(b"\n\n")
    if b"\r\n" in head:
        head, gap, data = content.partition(b"\r\n\r\n")
    if not head.startswith(b"NRRD") or not gap:
        raise ValueError("it has no NRRD header")
    lines = head.decode("ascii", "replace").splitlines()
    pairs = (re.split(": ?", line, maxsplit=1) for line in lines[1:] if ": " in line)
    fields = {key.strip().lower(): value.strip() for key, value in pairs}
    if "data file" in fields or "datafile" in fields:
        raise ValueError("its data are in another file")
    if fields["encoding"].lower() in ("gzip", "gz"):
        data = gzip.decompress(data)
    elif fields["encoding"].lower() != "raw":
        raise ValueError(f"its encoding is {fields['encoding']}, not raw or gzip")
    kind = np.dtype(_NRRD[fields["type"].lower()])
    big = fields.get("endian", "little").lower() == "big"
    sizes = [int(n) for n in fields["sizes"].split()]
    values = _shaped(data, kind.newbyteorder(">" if big else "<"), sizes[::-1])
    spatial = [k in ("space", "domain") for k in fields.get("kinds", "").split()]
    if values.ndim == 4 and spatial[:3] == [True] * 3:  # channels outermost
        values = values.transpose(1, 2, 3, 0)
    return values


def _shaped(data: bytes, kind: Any, shape: list[int]) -> NDArray[Any]:
    """Bytes as an array in this machine's byte order."""
    if min(shape) < 1 or math.prod(shape) * kind.itemsize > len(data):
        raise ValueError(f"it says {shape} values and has {len(data) // kind.itemsize}")
    values = np.frombuffer(data, kind, math.prod(shape)).reshape(shape)
    return values.astype(kind.newbyteorder("="), copy=False)


VTI_TAIL = b"\n</AppendedData>\n</VTKFile>\n"


def vti_head(values: NDArray[Any]) -> bytes:
    """What stands before the values in a .vti file; `VTI_TAIL` follows them.

    Example:
        >>> b'NumberOfComponents="3"' in vti_head(np.zeros((2, 3, 4, 3), np.uint8))
        True
    """
    d, h, w, c = values.shape
    extent = f"0 {w - 1} 0 {h - 1} 0 {d - 1}"
    kind = {1: "UInt8", 2: "UInt16", 4: "Float32"}[values.dtype.itemsize]
    text = f"""<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
<ImageData WholeExtent="{extent}" Origin="0 0 0" Spacing="1 1 1"><Piece Extent="{extent}">
<PointData Scalars="texture">
<DataArray type="{kind}" Name="texture" NumberOfComponents="{c}" format="appended" offset="0"/>
</PointData></Piece></ImageData>
<AppendedData encoding="raw">
_"""
    return text.encode() + np.array(values.nbytes, "<u8").tobytes()


def read_vti(content: bytes) -> NDArray[Any]:
    """The first array of a .vti file: appended (raw or base64) or binary, uncompressed.

    Raises:
        ValueError, KeyError: it is no such file.

    Example:
        >>> values = np.arange(24, dtype=np.uint8).reshape(2, 3, 4, 1)
        >>> file = vti_head(values) + values.tobytes() + VTI_TAIL
        >>> bool((read_vti(file) == values).all())
        True
    """
    text, appended, rest = content.partition(b"<AppendedData")
    root = ElementTree.fromstring(text + b"</VTKFile>" if appended else text)
    if root.get("type") != "ImageData" or root.get("compressor"):
        raise ValueError("it is no uncompressed ImageData")
    big = root.get("byte_order") == "BigEndian"
    piece, array = root.find(".//Piece"), root.find(".//DataArray")
    if piece is None or array is None:
        raise ValueError("it holds no DataArray")
    points = piece.find("PointData/DataArray") is not None
    low_high = [int(n) for n in piece.attrib["Extent"].split()]
    sizes = [b - a + points for a, b in zip(low_high[::2], low_high[1::2], strict=True)]
    encoded = rest.split(b">", 1)[0].find(b"base64") >= 0
    if array.get("format") == "appended":
        data = rest.split(b">", 1)[1].split(b"_", 1)[1][int(array.attrib["offset"]) :]
    elif array.get("format") == "binary":
        data, encoded = (array.text or "").strip().encode(), True
    else:
        raise ValueError(f"its format is {array.get('format')}, not appended or binary")
    if encoded:
        data = base64.b64decode(data.split(b"<", 1)[0].strip())
    data = data[8 if root.get("header_type") == "UInt64" else 4 :]
    kind = np.dtype(_VTI[array.attrib["type"]]).newbyteorder(">" if big else "<")
    components = int(array.get("NumberOfComponents", "1"))
    return _shaped(data, kind, [*sizes[::-1], components])
