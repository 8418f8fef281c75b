"""Pictures of textures on things, of volumes as cubes, and of meshes."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.image import check_image
from torchtex.meshes.cubes import cube, cube_cutaway
from torchtex.meshes.mesh import Mesh
from torchtex.meshes.placing import centred, wrapped
from torchtex.meshes.shapes import plane, shape
from torchtex.render.relief import normal_map
from torchtex.render.scene import Thing, draw
from torchtex.render.views import Camera, Light

VIEWS = {
    "sphere": Camera(20.0, 14.0, 4.0),
    "torus": Camera(15.0, 38.0, 4.1, (0.0, -0.02, 0.0)),
    "vase": Camera(20.0, 20.0, 4.2),
    "cube": Camera(32.0, 24.0, 3.9),
    "cylinder": Camera(20.0, 26.0, 4.0),
    "cone": Camera(20.0, 14.0, 4.0, (0.0, 0.1, 0.0)),
    "bowl": Camera(20.0, 34.0, 3.9),
    "knot": Camera(15.0, 14.0, 4.0),
    "plane": Camera(25.0, 16.0, 3.4, (0.0, -0.35, 0.0), 50.0),
    "cloth": Camera(12.0, 6.0, 3.9),
}
"""Cameras that suit the things of `SHAPES`."""

_HAZE = 22.0
_DAY, _SOFT = Light(), Light(sky=0.4)


def texture_picture(
    texture: Float[Tensor, "c h w"],
    thing: str | Mesh = "sphere",
    *,
    tiles: float = 1.0,
    normals: float = 0.0,
    ground: Float[Tensor, "k y x"] | None = None,
    gloss: float = 0.15,
    camera: Camera | None = None,
    light: Light = _DAY,
    size: tuple[int, int] = (512, 512),
    shadows: bool = True,
    samples: int = 3,
) -> Float[Tensor, "3 h2 w2"]:
    """A texture on a thing, or on the ground, in perspective and lit.

    Args:
        texture: (c, h, w) in [0, 1], repeated as a tile; of more than three channels the first
            three are shown.
        thing: one of `meshes.shapes.SHAPES`, or a mesh, which is wrapped as if in a ball if it has
            no `uv`.
        tiles: how many there are where there is one.
        normals: strength of a relief taken from the texture's lightness; 0 is smooth, and below 0
            dark parts are high.
        ground: texture of a floor below the thing; None for no floor.
        gloss: strength of the highlight.
        shadows: of the light, and less of the sky's light in corners.
        camera: one that suits the thing unless given; a mesh is moved before that one then.
        size: height and width of the picture.
        samples: every pixel is the mean of this number squared.

    Raises:
        ValueError: an unknown thing, no texture, or a number out of range.

    Example:
        >>> texture_picture(torch.rand(3, 8, 8), "torus", size=(16, 24), samples=1).shape
        torch.Size([3, 16, 24])
    """
    check_image(texture, "texture")
    _check(tiles, normals, gloss)
    mesh = shape(thing, "thing") if isinstance(thing, str) else _placed(thing, camera)
    mesh = wrapped(mesh)
    view = VIEWS.get(thing, Camera()) if isinstance(thing, str) else Camera()
    flat = thing == "plane"
    relief = normal_map(texture, normals) if normals else None
    things = [Thing(mesh.tiled(tiles), texture, normals=relief, gloss=gloss, shadow=not flat)]
    if ground is not None and not flat:
        check_image(ground, "ground")
        things.append(_floor(mesh, ground))
    haze = _HAZE if len(things) > 1 or flat else math.inf
    chosen = view if camera is None else camera
    return draw(
        things, chosen, light, size, haze=haze, shadows=shadows, corners=shadows, samples=samples
    )


def mesh_picture(
    mesh: Mesh,
    *,
    color: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n c"]] | None = None,
    gloss: float = 0.15,
    camera: Camera | None = None,
    light: Light = _DAY,
    size: tuple[int, int] = (512, 512),
    shadows: bool = True,
    samples: int = 3,
) -> Float[Tensor, "3 h w"]:
    """A mesh with a solid texture, or else with the texture or the colours that came with it.

    Args:
        color: of places (n, 3), the mesh's `places` if it has them, else its vertices.
        camera: as in `texture_picture`.
        gloss, light, size, shadows, samples: as in `texture_picture`.

    Raises:
        ValueError: a number out of range.

    Example:
        >>> from torchtex.meshes.shapes import sphere
        >>> mesh_picture(sphere(8), color=lambda p: p / 2 + 0.5, size=(16, 16), samples=1).shape
        torch.Size([3, 16, 16])
    """
    _check(1.0, 0.0, gloss)
    chosen = Camera() if camera is None else camera
    own = mesh.texture if color is None else None
    thing = Thing(_placed(mesh, camera), own, color=color, gloss=gloss)
    return draw([thing], chosen, light, size, shadows=shadows, corners=shadows, samples=samples)


def volume_picture(
    volume: Float[Tensor, "c d h w"],
    *,
    cut: float | None = 0.5,
    camera: Camera | None = None,
    light: Light = _SOFT,
    size: tuple[int, int] = (512, 512),
    samples: int = 3,
) -> Float[Tensor, "3 y x"]:
    """A volume as a block, of which a corner is cut away.

    The front is its first slice, with rows down and columns to the right; depth goes back.

    Args:
        volume: (c, d, h, w) in [0, 1].
        cut: share of each edge that is gone; None for the whole block.
        camera, light, size, samples: as in `texture_picture`.

    Raises:
        ValueError: no volume, or a number out of range.

    Example:
        >>> volume_picture(torch.rand(3, 8, 8, 8), size=(16, 16), samples=1).shape
        torch.Size([3, 16, 16])
    """
    if not volume.numel() or not volume.is_floating_point():
        raise ValueError(f"volume is {volume.dtype} of {tuple(volume.shape)}; give floats")
    mesh = cube() if cut is None else cube_cutaway(cut)
    depth, height, width = volume.shape[1:]
    longest = max(depth, height, width)
    extent = mesh.vertices.new_tensor([width, height, depth]) / longest
    block = replace(mesh, vertices=mesh.vertices * extent)
    view = Camera(36.0, 30.0, 3.9) if camera is None else camera
    thing = Thing(block, color=solid(volume), gloss=0.05)
    return draw([thing], view, light, size, shadows=False, samples=samples)


def solid(
    volume: Float[Tensor, "c d h w"],
) -> Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n c"]]:
    """Colours of a volume at places (x, y, z) in [0, 1]: right, up and towards the front.

    Example:
        >>> solid(torch.ones(3, 4, 4, 4))(torch.rand(5, 3)).shape
        torch.Size([5, 3])
    """
    values = volume.detach().float()[None]

    def color(places: Tensor) -> Tensor:
        x, y, z = places.float().unbind(1)
        grid = torch.stack([2 * x - 1, 1 - 2 * y, 1 - 2 * z], 1).view(1, 1, 1, -1, 3)
        read = F.grid_sample(values, grid, padding_mode="border", align_corners=False)
        return read[0, :, 0, 0].T

    return color


def _placed(mesh: Mesh, camera: Camera | None) -> Mesh:
    """The mesh as the usual camera sees it well, or as it is for a camera of the caller's."""
    return centred(mesh) if camera is None else mesh


def _floor(mesh: Mesh, texture: Tensor) -> Thing:
    level = plane()
    low = float(mesh.vertices[:, 1].min())
    below = level.vertices + level.vertices.new_tensor([0.0, low, 0.0])
    return Thing(replace(level, vertices=below), texture, gloss=0.0, shadow=False)


def _check(tiles: float, normals: float, gloss: float) -> None:
    if not 0 < tiles <= 1000:
        raise ValueError(f"tiles={tiles} must be above 0 and at most 1000")
    if not abs(normals) <= 100:
        raise ValueError(f"normals={normals} must lie in -100..100")
    if not 0 <= gloss <= 10:
        raise ValueError(f"gloss={gloss} must lie in 0..10")
