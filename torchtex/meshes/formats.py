"""Meshes as bytes: glTF in one binary file, PLY, and Wavefront OBJ with its material.

Colours of pictures and of vertices are sRGB here, as everywhere in torchtex. glTF wants those of
vertices linear, and so they are converted; viewers would show them pale otherwise.
"""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchtex import codecs
from torchtex.meshes.mesh import Mesh

_FLOAT, _INDEX = 5126, 5125  # what glTF calls the types of numbers
_VERTICES, _FACES = 34962, 34963  # and what a view is for
_POINTS, _TRIANGLES, _REPEAT, _LINEAR, _MIPMAPS = 0, 4, 10497, 9729, 9987
_ROUGH = 0.9


def glb(mesh: Mesh) -> bytes:
    """A .glb file: the mesh with one rough material, which is no metal.

    Its colour is the texture, or white, which the colours of vertices are multiplied with.

    Source: glTF 2.0 specification, Khronos Group.

    Example:
        >>> glb(Mesh(torch.eye(3), torch.tensor([[0, 1, 2]])))[:4]
        b'glTF'
    """
    parts = _Parts()
    attributes = {"POSITION": parts.numbers(_floats(mesh.vertices), limits=True)}
    if mesh.normals is not None and len(mesh.faces):
        attributes["NORMAL"] = parts.numbers(_floats(mesh.normals))
    material: dict[str, Any] = {
        "baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": _ROUGH,
    }  # fmt: skip
    about: dict[str, Any] = {}
    if mesh.texture is not None and mesh.uv is not None:
        attributes["TEXCOORD_0"] = parts.numbers(_floats(mesh.uv.flip(1)))
        picture = {"bufferView": parts.view(png(mesh.texture)), "mimeType": "image/png"}
        sampler = {"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _REPEAT, "wrapT": _REPEAT}
        about = {
            "images": [picture], "samplers": [sampler], "textures": [{"source": 0, "sampler": 0}],
        }  # fmt: skip
        material["baseColorTexture"] = {"index": 0}
    elif mesh.colors is not None:
        attributes["COLOR_0"] = parts.numbers(_floats(to_linear(_rgb(mesh.colors))))
    primitive = {"attributes": attributes, "material": 0, "mode": _POINTS}
    if len(mesh.faces):
        index = mesh.faces.flatten().numpy().astype("<u4")
        primitive |= {"mode": _TRIANGLES, "indices": parts.numbers(index, _FACES)}
    about |= {
        "asset": {"version": "2.0", "generator": "torchtex"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": material, "doubleSided": not mesh.closed}],
        "accessors": parts.accessors,
        "bufferViews": parts.views,
        "buffers": [{"byteLength": len(parts.data)}],
    }
    text = json.dumps(about, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = b"".join(
        np.array(len(chunk), "<u4").tobytes() + kind + chunk
        for kind, chunk in ((b"JSON", text), (b"BIN\0", bytes(parts.data)))
    )
    return b"glTF" + np.array([2, 12 + len(chunks)], "<u4").tobytes() + chunks


class _Parts:
    """The binary part of a .glb, and what its pieces are."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        """Appends bytes; the number of the view of them."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.views.append(view if target is None else view | {"target": target})
        self.data += content + bytes(-len(content) % 4)
        return len(self.views) - 1

    def numbers(self, values: NDArray[Any], target: int = _VERTICES, limits: bool = False) -> int:
        """Appends an array, one row a vertex; the number of its accessor."""
        accessor: dict[str, Any] = {
            "bufferView": self.view(values.tobytes(), target),
            "componentType": _FLOAT if values.dtype.kind == "f" else _INDEX,
            "count": len(values),
            "type": "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}",
        }
        if limits:
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def ply(mesh: Mesh) -> bytes:
    """A binary .ply file, with normals and colours of vertices where there are any.

    Example:
        >>> ply(Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))).splitlines()[2]
        b'element vertex 3'
    """
    columns: list[tuple[str, str, NDArray[Any]]] = [
        (name, "float", _floats(mesh.vertices[:, k])) for k, name in enumerate("xyz")
    ]
    if mesh.normals is not None and len(mesh.faces):
        up = _floats(mesh.normals)
        columns += [(f"n{name}", "float", up[:, k]) for k, name in enumerate("xyz")]
    if mesh.colors is not None:
        shades = _bytes(_rgb(mesh.colors))
        columns += [
            (name, "uchar", shades[:, k]) for k, name in enumerate(("red", "green", "blue"))
        ]
    rows = np.empty(len(mesh.vertices), [(name, values.dtype) for name, _, values in columns])
    for name, _, values in columns:
        rows[name] = values
    head = [f"element vertex {len(rows)}"]
    head += [f"property {kind} {name}" for name, kind, _ in columns]
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"], faces["corners"] = 3, mesh.faces.numpy()
    if len(faces):
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    lines = ["ply", "format binary_little_endian 1.0", *head, "end_header"]
    return ("\n".join(lines) + "\n").encode() + rows.tobytes() + faces.tobytes()


def obj(mesh: Mesh, material: str | None = None) -> bytes:
    """An .obj file: colours of vertices stand behind their places, as most readers take them.

    Args:
        material: file of the material `surface`, as `mtl` makes it, for a mesh with a texture.

    Example:
        >>> print(obj(Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))).decode().splitlines()[-1])
        f 1 2 3
    """
    shades = mesh.colors if material is None else None
    places = [mesh.vertices] if shades is None else [mesh.vertices, _rgb(shades).clamp(0, 1)]
    lines = [] if material is None else [f"mtllib {material}", "usemtl surface"]
    lines += _rows("v", torch.cat(places, 1))
    shared = ["{0}"]
    if material is not None and mesh.uv is not None:
        across = torch.stack([mesh.uv[:, 1], 1 - mesh.uv[:, 0]], 1)
        lines += _rows("vt", across)
        shared = ["{0}/{0}"]
    if mesh.normals is not None:
        lines += _rows("vn", mesh.normals)
        shared = [shared[0] + ("/{0}" if material is not None else "//{0}")]
    corner = shared[0].format
    for face in (mesh.faces + 1).tolist():
        lines.append("f " + " ".join(corner(number) for number in face))
    return ("\n".join(lines) + "\n").encode()


def mtl(picture: str) -> bytes:
    """The .mtl file of an .obj with a texture.

    Args:
        picture: name of its file.

    Example:
        >>> mtl("wood.png").decode().splitlines()[-1]
        'map_Kd wood.png'
    """
    lines = ("newmtl surface", "Ka 1 1 1", "Kd 1 1 1", "Ks 0 0 0", "illum 1", f"map_Kd {picture}")
    return ("\n".join(lines) + "\n").encode()


def png(texture: Float[Tensor, "c h w"]) -> bytes:
    """A texture as a PNG of 8 bits.

    Example:
        >>> png(torch.rand(3, 4, 4))[1:4]
        b'PNG'
    """
    pixels = _bytes(_rgb(texture.flatten(1).T)).reshape(*texture.shape[1:], 3)
    return codecs.png(pixels, {})


def to_linear(colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """sRGB colours as amounts of light.

    Example:
        >>> round(to_linear(torch.full((1, 3), 0.5))[0, 0].item(), 3)
        0.214
    """
    values = colors.clamp(0, 1)
    return torch.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def from_linear(light: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """The inverse of `to_linear`.

    Example:
        >>> round(from_linear(torch.full((1, 3), 0.214))[0, 0].item(), 3)
        0.5
    """
    values = light.clamp(0, 1)
    curved = 1.055 * values.clamp(min=1e-9) ** (1 / 2.4) - 0.055
    return torch.where(values <= 0.0031308, 12.92 * values, curved)


def _rgb(colors: Tensor) -> Tensor:
    """Three channels: grey is repeated, what is more is left out."""
    return colors[:, :3] if colors.shape[1] >= 3 else colors[:, :1].expand(-1, 3)


def _floats(values: Tensor) -> NDArray[Any]:
    return np.ascontiguousarray(values.numpy().astype("<f4"))


def _bytes(values: Tensor) -> NDArray[Any]:
    return (values.clamp(0, 1) * 255).round().numpy().astype(np.uint8)


def _rows(name: str, values: Tensor) -> Sequence[str]:
    return [f"{name} " + " ".join(f"{v:.7g}" for v in row) for row in values.double().tolist()]
