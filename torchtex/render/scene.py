"""Scenes: things with textures, a camera and a light, drawn in software.

Colours are taken for sRGB and shaded in linear light: what the sky gives all around, Lambert's
law for the light, a highlight after Blinn and Phong, and shadows from depth maps seen from there.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.meshes.mesh import Mesh, joined
from torchtex.render.raster import Hits, Mipmaps, mipmaps, rasterize
from torchtex.render.relief import bent, tangents
from torchtex.render.shadows import Lamp, Sky
from torchtex.render.views import Camera, Light, Place, direction

Colors = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n c"]]

_GAMMA = 2.2
_SAMPLES = 2**20  # pixels, before they are averaged, in one band of rows


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
        shadow: whether it throws one, and keeps the sky from places.

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


def draw(
    things: Sequence[Thing],
    camera: Camera,
    light: Light,
    size: tuple[int, int],
    *,
    background: tuple[Place, Place] = ((0.93, 0.95, 0.97), (0.74, 0.78, 0.82)),
    haze: float = math.inf,
    shadows: bool = True,
    corners: bool = True,
    samples: int = 3,
) -> Float[Tensor, "3 h w"]:
    """The picture of a scene, in [0, 1].

    Args:
        size: height and width.
        background: colours at the top and at the bottom.
        haze: distance at which most of a thing's colour has turned into the background's.
        shadows: of the light.
        corners: less of the sky's light reaches corners, and places under things.
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
    inside = [thing.mesh for thing in things if thing.shadow]
    lamp = Lamp(inside if shadows and light.strength else [], light.azimuth, light.elevation)
    heaven = Sky(inside) if corners and inside and light.sky else None
    scene = _Scene(tuple(things), camera, light, wide, haze, lamp, heaven, samples)
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
        lamp: Lamp,
        heaven: Sky | None,
        samples: int,
    ) -> None:
        self.things, self.camera, self.light = things, camera, light
        self.size, self.haze = size, haze
        self.lamp, self.heaven, self.samples = lamp, heaven, samples
        whole = joined([Mesh(thing.mesh.vertices, thing.mesh.faces) for thing in things])
        self.seen, self.faces = camera.seen(whole.vertices, size), whole.faces
        self.starts = [0, *accumulate(len(thing.mesh.faces) for thing in things)]
        self.textures = [_maybe_mipmaps(thing.texture) for thing in things]
        self.reliefs = [_maybe_mipmaps(thing.normals) for thing in things]

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
            smooth = _normals(thing.mesh, face, weights)
            color, normal = self._surface(number, hits, pixels, face, weights, smooth)
            toward = F.normalize(place.new_tensor(self.camera.eye) - place, dim=1)
            away = (_face_normals(thing.mesh)[face] * toward).sum(1, keepdim=True) < 0
            smooth, normal = (torch.where(away, -n, n) for n in (smooth, normal))  # both are seen
            sky, direct = self._reached(place, smooth, pixels)
            lit = self._lit(thing, color, normal, toward, sky, direct)
            old = empty[pixels[:, 0], pixels[:, 1]]
            far = (place - place.new_tensor(self.camera.eye)).norm(dim=1, keepdim=True)
            clear = torch.exp(-((far / self.haze) ** 4) * 2)
            empty[pixels[:, 0], pixels[:, 1]] = old + clear * (lit - old)
        return empty

    def _surface(
        self,
        number: int,
        hits: Hits,
        pixels: Tensor,
        face: Tensor,
        weights: Tensor,
        normal: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Colour, linear, and normal of every pixel."""
        thing, mesh = self.things[number], self.things[number].mesh
        corners = mesh.faces[face]
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
            normal = bent(normal, relief(at, *steps), *(t[face] for t in tangents(mesh)))
        return color.clamp(0, 1) ** _GAMMA, normal

    def _lit(
        self,
        thing: Thing,
        color: Tensor,
        normal: Tensor,
        view: Tensor,
        sky: Tensor,
        direct: Tensor,
    ) -> Tensor:
        """Light that goes to the camera, of what reaches each place from the sky and the lamp."""
        toward = view.new_tensor(direction(self.light.azimuth, self.light.elevation))
        lambert = (normal @ toward).clamp(min=0)
        half = F.normalize(view + toward, dim=1)
        highlight = (normal * half).sum(1).clamp(min=0) ** thing.shine * (lambert > 0)
        around = sky * (0.8 + 0.2 * normal[:, 1])
        return (
            color * (around + direct * lambert)[:, None]
            + ((direct * thing.gloss * highlight)[:, None])
        )

    def _reached(self, place: Tensor, normal: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """What comes from the sky, and from the lamp, before surfaces are turned away from it."""
        sky = self.light.sky * self._open(place, normal, pixels)
        return sky, self.light.strength * self.lamp(place, normal)

    def _open(self, place: Tensor, normal: Tensor, pixels: Tensor) -> Tensor:
        """How much of the sky each sees; alike in a pixel of the picture for one way of facing."""
        if self.heaven is None:
            return place.new_ones(len(place))
        row, column = (pixels // self.samples).unbind(1)
        way = 2 * normal.abs().argmax(1)
        way = way + (normal.gather(1, way[:, None] // 2)[:, 0] < 0)
        key = (row * self.size[1] + column) * 6 + way
        _, group = torch.unique(key, return_inverse=True)
        count = int(group.max()) + 1
        first = torch.full((count,), len(key), device=key.device)
        first.scatter_reduce_(0, group, torch.arange(len(key), device=key.device), "amin")
        return self.heaven(place[first], normal[first])[group]


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


def _normals(mesh: Mesh, face: Tensor, weights: Tensor) -> Tensor:
    """Of places on faces, smooth if the mesh has normals."""
    if mesh.normals is None:
        return _face_normals(mesh)[face]
    return F.normalize(_mean(mesh.normals, mesh.faces[face], weights), dim=1)
