"""Reliefs: normal maps from the lightness of a texture, and normals that they bend."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.image import luminance
from torchtex.meshes.mesh import Mesh


def normal_map(texture: Float[Tensor, "c h w"], strength: float = 1.0) -> Float[Tensor, "3 h w"]:
    """Normals of a relief that is high where the texture is light; periodic, of length 1.

    Args:
        strength: slope where lightness changes by a tenth from pixel to pixel; below 0 dark
            parts are high.

    Returns:
        x to the right, y up, z out of the surface; (n + 1) / 2 is the usual picture of it.

    Example:
        >>> normal_map(torch.full((3, 4, 4), 0.5))[2].min().item()
        1.0
    """
    light = luminance(texture)
    for axis in (0, 1):  # grain of single pixels is no relief
        light = (light.roll(1, axis) + 2 * light + light.roll(-1, axis)) / 4
    right, down = ((light.roll(-1, axis) - light.roll(1, axis)) / 2 for axis in (1, 0))
    slopes = 10 * strength * torch.stack([-right, down])
    return F.normalize(torch.cat([slopes, torch.ones_like(light)[None]]), dim=0)


def tangents(mesh: Mesh) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Down and to the right on the texture, of every face, in space.

    Example:
        >>> corners, uv = torch.eye(3), torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
        >>> tangents(Mesh(corners, torch.tensor([[0, 1, 2]]), uv))[1][0, :2].tolist()
        [-1.0, 1.0]
    """
    assert mesh.uv is not None
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    p, q, r = mesh.uv.double()[mesh.faces].unbind(1)
    one, two, first, second = b - a, c - a, q - p, r - p
    area = first[:, :1] * second[:, 1:] - first[:, 1:] * second[:, :1]
    area = torch.where(area.abs() < 1e-15, 1.0, area)
    down = (one * second[:, 1:] - two * first[:, 1:]) / area
    right = (two * first[:, :1] - one * second[:, :1]) / area
    return down, right


def bent(
    normal: Float[Tensor, "n 3"],
    relief: Float[Tensor, "n 3"],
    down: Float[Tensor, "n 3"],
    right: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 3"]:
    """Normals turned as a normal map says.

    Args:
        relief: what the map holds there, as of `normal_map`.
        down, right: ways on the texture, in space.

    Example:
        >>> x, y, z = torch.eye(3)[:, None].unbind(0)
        >>> bent(z, x, -y, x).tolist()
        [[1.0, 0.0, 0.0]]
    """
    level = [
        F.normalize(way - (way * normal).sum(1, keepdim=True) * normal, dim=1)
        for way in (right, -down)
    ]
    x, y, z = relief.unbind(1)
    bent = x[:, None] * level[0] + y[:, None] * level[1] + z[:, None] * normal
    return F.normalize(bent, dim=1)
