"""Scenes: things with textures, a camera and a light, drawn in software.

Colours are taken for sRGB and shaded in linear light: what the sky gives all around, Lambert's
law for the light, a highlight after Blinn and Phong, and shadows from a depth map seen from it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.image import luminance
from torchtex.meshes.mesh import Mesh
from torchtex.render.raster import Hits, Mipmaps, mipmaps, rasterize
from torchtex.render.views import Camera, Light, Place, direction

Colors = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n c"]]

_GAMMA = 2.2
_SAMPLES = 2**20  # pixels, before they are averaged, in one band of rows
_SHADOW = 768  # pixels, of the side of the depth map


@dataclass(frozen=True, eq=False)
class Thing:
    """A mesh and what its surface looks like: a texture, a function of the place, or its colours.

    Args:
        mesh: with `uv` for a texture.
        texture: (c, h, w), which repeats.
        color: of places (n, 3), the mesh's `places` if it has them: a solid texture.
        normals: (3, h, w), a normal map as of `normal_map`, aligned with the texture.
        gloss: strength of the highlight.
        shine: the larger, the smaller the highlight is.
        shadow: whether it throws one.

    Raises:
        ValueError: a mesh without triangles, or a texture for one that has no places on it.

    Example:
        >>> from torchtex.meshes.shapes import sphere
        >>> Thing(sphere(), color=lambda place: place).texture is None
        True
    """

    mesh: Mesh
    texture: Float[Tensor, "c h w"] | None = None
    color: Colors | None = None
    normals: Float[Tensor, "3 h w"] | None = None
    gloss: float = 0.15
    shine: float = 40.0
    shadow: bool = True

    def __post_init__(self) -> None:
        if not len(self.mesh.faces):
            raise ValueError(
                "mesh has no triangles, so there is nothing to see; give one with some"
            )
        if self.mesh.uv is None and (self.texture is not None or self.normals is not None):
            raise ValueError(
                "mesh has no places on a texture (uv); use wrapped(mesh), or give a color"
            )


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


def draw(
    things: Sequence[Thing],
    camera: Camera,
    light: Light,
    size: tuple[int, int],
    *,
    background: tuple[Place, Place] = ((0.93, 0.95, 0.97), (0.74, 0.78, 0.82)),
    haze: float = math.inf,
    shadows: bool = True,
    samples: int = 3,
) -> Float[Tensor, "3 h w"]:
    """The picture of a scene, in [0, 1].

    Args:
        size: height and width.
        background: colours at the top and at the bottom.
        haze: distance at which most of a thing's colour has turned into the background's.
        samples: every pixel is the mean of this number squared.

    Raises:
        ValueError: nothing to draw, or a size or number of samples that is none.

    Example:
        >>> from torchtex.meshes.shapes import sphere
        >>> ball = Thing(sphere(8), torch.rand(3, 8, 8))
        >>> draw([ball], Camera(), Light(), (16, 16), samples=1).shape
        torch.Size([3, 16, 16])
    """
    if not things:
        raise ValueError("things is empty; give at least one")
    if min(size) < 1 or max(size) > 16384:
        raise ValueError(f"size={tuple(size)} must lie in 1..16384 pixels each way")
    if not 1 <= samples <= 8:
        raise ValueError(f"samples={samples} must lie in 1..8")
    wide = (size[0] * samples, size[1] * samples)
    scene = _Scene(tuple(things), camera, light, wide, haze, shadows)
    sky = [torch.tensor(color).double() ** _GAMMA for color in background]
    band = max(1, _SAMPLES // (wide[1] * samples)) * samples
    parts = []
    for top in range(0, wide[0], band):
        rows = (top, min(top + band, wide[0]))
        share = (torch.arange(*rows).double() + 0.5)[:, None, None] / wide[0]
        empty = (sky[0] + share * (sky[1] - sky[0])).expand(-1, wide[1], -1).clone()
        colors = scene.band(rows, empty).permute(2, 0, 1)[None]
        parts.append(F.avg_pool2d(colors, samples)[0])
    return (torch.cat(parts, 1).clamp(0, 1) ** (1 / _GAMMA)).float()


class _Scene:
    """Everything that the bands of a picture share."""

    def __init__(
        self,
        things: tuple[Thing, ...],
        camera: Camera,
        light: Light,
        size: tuple[int, int],
        haze: float,
        shadows: bool,
    ) -> None:
        self.things, self.camera, self.light = things, camera, light
        self.size, self.haze = size, haze
        self.vertices, self.faces, self.starts = _together([thing.mesh for thing in things])
        self.seen = camera.seen(self.vertices, size)
        self.textures = [_maybe_mipmaps(thing.texture) for thing in things]
        self.reliefs = [_maybe_mipmaps(thing.normals) for thing in things]
        self.shade = _Shade(things, light) if shadows and light.strength else None

    def band(self, rows: tuple[int, int], empty: Tensor) -> Tensor:
        """(h, w, 3), linear light, drawn over the empty one."""
        hits = rasterize(self.seen, self.faces, self.size, rows=rows)
        for number, thing in enumerate(self.things):
            here = (hits.triangle >= self.starts[number]) & (
                hits.triangle < self.starts[number + 1]
            )
            pixels = here.nonzero()
            if not len(pixels):
                continue
            weights = hits.weights(pixels)
            face = hits.triangle[here] - self.starts[number]
            place = _mean(thing.mesh.vertices, thing.mesh.faces[face], weights)
            color, normal = self._surface(number, hits, pixels, face, weights)
            lit = self._lit(thing, color, normal, place)
            old = empty[pixels[:, 0], pixels[:, 1]]
            away = (place - place.new_tensor(self.camera.eye)).norm(dim=1, keepdim=True)
            clear = torch.exp(-((away / self.haze) ** 4) * 2)
            empty[pixels[:, 0], pixels[:, 1]] = old + clear * (lit - old)
        return empty

    def _surface(
        self, number: int, hits: Hits, pixels: Tensor, face: Tensor, weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Colour, linear, and normal of every pixel."""
        thing, mesh = self.things[number], self.things[number].mesh
        corners = mesh.faces[face]
        normal = _face_normals(mesh)[face]
        if mesh.normals is not None:
            normal = F.normalize(_mean(mesh.normals, corners, weights), dim=1)
        color = torch.full((len(pixels), 3), 0.75, dtype=torch.float64)
        steps: list[Tensor] = []
        if mesh.uv is not None:
            at = _mean(mesh.uv, corners, weights)
            for down, right in ((1.0, 0.0), (0.0, 1.0)):
                aside = hits.weights(pixels, down, right)
                steps.append(_mean(mesh.uv, corners, aside) - at)
        texture, relief = self.textures[number], self.reliefs[number]
        if texture is not None:
            color = _rgb(texture(at, *steps))
        elif thing.color is not None:
            places = mesh.vertices if mesh.places is None else mesh.places
            color = _rgb(thing.color(_mean(places, corners, weights).to(places)).double())
        elif mesh.colors is not None:
            color = _rgb(_mean(mesh.colors, corners, weights))
        if relief is not None:
            normal = _bent(normal, relief(at, *steps), *(t[face] for t in _tangents(mesh)))
        return color.clamp(0, 1) ** _GAMMA, normal

    def _lit(self, thing: Thing, color: Tensor, normal: Tensor, place: Tensor) -> Tensor:
        view = F.normalize(place.new_tensor(self.camera.eye) - place, dim=1)
        facing = (normal * view).sum(1, keepdim=True)
        normal = torch.where(facing < 0, -normal, normal)  # both sides are seen
        toward = place.new_tensor(direction(self.light.azimuth, self.light.elevation))
        lambert = (normal @ toward).clamp(min=0)
        half = F.normalize(view + toward, dim=1)
        highlight = (normal * half).sum(1).clamp(min=0) ** thing.shine * (lambert > 0)
        reached = torch.ones_like(lambert) if self.shade is None else self.shade(place, normal)
        sky = self.light.sky * (0.8 + 0.2 * normal[:, 1])
        direct = self.light.strength * reached
        return (
            color * (sky + direct * lambert)[:, None] + (direct * thing.gloss * highlight)[:, None]
        )


class _Shade:
    """How much of the light reaches a place: the things as seen from a lamp far away."""

    def __init__(self, things: Sequence[Thing], light: Light) -> None:
        meshes = [thing.mesh for thing in things if thing.shadow]
        self.depth: Tensor | None = None
        if not meshes:
            return
        vertices, faces, _ = _together(meshes)
        middle = (vertices.amin(0) + vertices.amax(0)) / 2
        radius = float((vertices - middle).norm(dim=1).max()) * 1.02
        a, b, c = middle.tolist()
        fov = math.degrees(2 * math.asin(1 / 12))
        self.lamp = Camera(light.azimuth, light.elevation, 12 * radius, (a, b, c), fov)
        self.radius = radius
        seen = self.lamp.seen(vertices, (_SHADOW, _SHADOW))
        self.depth = rasterize(seen, faces, (_SHADOW, _SHADOW)).depth

    def __call__(self, place: Tensor, normal: Tensor) -> Tensor:
        if self.depth is None:
            return torch.ones(len(place), dtype=torch.float64)
        lifted = place + 0.02 * self.radius * normal  # so that nothing shades itself
        x, y, w = self.lamp.seen(lifted, (_SHADOW, _SHADOW)).unbind(1)
        column, row = x / w, y / w
        total = torch.zeros_like(w)
        taps = (-2.25, -0.75, 0.75, 2.25)
        for down in taps:
            for right in taps:
                i, j = (row + down).round().long(), (column + right).round().long()
                inside = (i >= 0) & (i < _SHADOW) & (j >= 0) & (j < _SHADOW)
                nearest = self.depth[i.clamp(0, _SHADOW - 1), j.clamp(0, _SHADOW - 1)]
                total += (~inside | (nearest * w <= 1 + 1e-6)).double()
        return total / len(taps) ** 2


def _together(meshes: Sequence[Mesh]) -> tuple[Tensor, Tensor, list[int]]:
    """All vertices and faces, and the number of the first face of each mesh."""
    faces, starts, shift = [], [0], 0
    for mesh in meshes:
        faces.append(mesh.faces + shift)
        shift += len(mesh.vertices)
        starts.append(starts[-1] + len(mesh.faces))
    return torch.cat([mesh.vertices for mesh in meshes]), torch.cat(faces), starts


def _maybe_mipmaps(texture: Tensor | None) -> Mipmaps | None:
    return None if texture is None else mipmaps(texture.detach().double())


def _mean(values: Tensor, corners: Tensor, weights: Tensor) -> Tensor:
    total: Tensor | float = 0.0
    for corner in range(3):
        total = total + values.double()[corners[:, corner]] * weights[:, corner, None]
    assert isinstance(total, Tensor)
    return total


def _rgb(color: Tensor) -> Tensor:
    """Three channels: grey is repeated, what is more is left out."""
    return color[:, :3] if color.shape[1] >= 3 else color[:, :1].expand(-1, 3)


def _face_normals(mesh: Mesh) -> Tensor:
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    return F.normalize(torch.linalg.cross(b - a, c - a), dim=1)


def _tangents(mesh: Mesh) -> tuple[Tensor, Tensor]:
    """Down and to the right on the texture, of every face."""
    assert mesh.uv is not None
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    p, q, r = mesh.uv.double()[mesh.faces].unbind(1)
    one, two, first, second = b - a, c - a, q - p, r - p
    area = first[:, :1] * second[:, 1:] - first[:, 1:] * second[:, :1]
    area = torch.where(area.abs() < 1e-15, 1.0, area)
    down = (one * second[:, 1:] - two * first[:, 1:]) / area
    right = (two * first[:, :1] - one * second[:, :1]) / area
    return down, right


def _bent(normal: Tensor, relief: Tensor, down: Tensor, right: Tensor) -> Tensor:
    """The normal turned as a normal map says."""
    level = [
        F.normalize(way - (way * normal).sum(1, keepdim=True) * normal, dim=1)
        for way in (right, -down)
    ]
    x, y, z = relief.unbind(1)
    bent = x[:, None] * level[0] + y[:, None] * level[1] + z[:, None] * normal
    return F.normalize(bent, dim=1)
