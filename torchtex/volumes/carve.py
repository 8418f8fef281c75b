"""Things carved out of a volume of texture: its colours where the surface passes through it."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.volumes.files import check_volume
from torchtex.volumes.meshes import Surface, atlas, save_mesh, subdivide

_AT_ONCE = 2**20  # places that are sampled at a time


@dataclass(frozen=True, eq=False)
class Carved:
    """A mesh with its colours.

    Args:
        surface: as it was, in smaller triangles, or in triangles with vertices of their own.
        colors: of every vertex; None where there is a texture.
        texture: of a baked mesh.
        places: of every vertex on the texture: row and column in its pixels.
    """

    surface: Surface
    colors: Float[Tensor, "v 3"] | None = None
    texture: Float[Tensor, "3 h w"] | None = None
    places: Float[Tensor, "v 2"] | None = None

    def save(self, path: str | Path) -> None:
        """Writes it; see `meshes.save_mesh`.

        Raises:
            ValueError: a name that it cannot be written to.
            ImportError: trimesh is not installed.
        """
        save_mesh(path, self.surface, colors=self.colors, texture=self.texture, places=self.places)


def sample(volume: Float[Tensor, "c d h w"], places: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
    """A volume, repeated without end, at places between its voxels: trilinear.

    Args:
        places: depth, row and column, in voxels; the centre of the first voxel is (0, 0, 0).

    Example:
        >>> volume = torch.arange(4.0).view(1, 1, 1, 4)
        >>> sample(volume, torch.tensor([[0.0, 0.0, 1.25], [7.0, 0.0, 3.5]]))[:, 0].tolist()
        [1.25, 1.5]
    """
    flat = volume.flatten(1)
    _, h, w = extents = volume.shape[1:]
    found = []
    for some in places.split(_AT_ONCE):
        low = some.floor()
        share = (some - low).to(volume)
        corners = [low.long() % torch.tensor(extents), (low.long() + 1) % torch.tensor(extents)]
        total = volume.new_zeros(len(some), len(volume))
        for corner in range(8):
            sides = [corner >> 2 & 1, corner >> 1 & 1, corner & 1]
            z, y, x = (corners[side][:, axis] for axis, side in enumerate(sides))
            parts = [share[:, a] if side else 1 - share[:, a] for a, side in enumerate(sides)]
            weight = parts[0] * parts[1] * parts[2]
            total += weight[:, None] * flat[:, (z * h + y) * w + x].T
        found.append(total)
    return torch.cat(found) if found else volume.new_zeros(0, len(volume))


def carve(
    volume: Float[Tensor, "c d h w"],
    surface: Surface,
    *,
    scale: float = 1.0,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    detail: float = 1.0,
    bake: int | None = None,
) -> Carved:
    """A mesh with the colours of a volume: x runs along its columns, y up its rows, z to its front.

    Args:
        volume: (c, d, h, w) in [0, 1], of one or three channels; it repeats without end.
        scale: how often the longest side of the volume fits along the longest side of the mesh.
        shift: depth, row and column of the volume at the mesh's corner behind, above and to the
            left, in voxels.
        detail: longest edge of the triangles that get colours at their corners, in voxels.
        bake: side of a texture that holds the colours instead, in pixels; triangles stay.

    Raises:
        ValueError: a volume of other channels, or an option out of range.

    Example:
        >>> flat = Surface(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(3, 3))
        >>> carve(torch.rand(3, 8, 8, 8), flat).colors.shape[1]
        3
    """
    check_volume(volume)
    if len(volume) not in (1, 3):
        raise ValueError(f"volume has {len(volume)} channels; a mesh can show 1 or 3")
    for name, value in (("scale", scale), ("detail", detail)):
        if not 0 < value < float("inf"):
            raise ValueError(f"{name}={value} must be above 0, and finite")
    if bake is not None and not 8 <= bake <= 16384:
        raise ValueError(f"bake={bake} must lie in 8..16384 pixels")
    low, high = surface.vertices.amin(0), surface.vertices.amax(0)
    voxels = scale * max(volume.shape[1:]) / float((high - low).max().clamp(min=1e-30))
    start = torch.tensor(shift, dtype=torch.float64)

    def colours(points: Tensor) -> Tensor:
        x, y, z = ((points - low).double() * voxels).unbind(1)
        up, front = ((high - low).double() * voxels)[1:]
        places = torch.stack([front - z, up - y, x], 1) + start - 0.5
        found = sample(volume, places)
        return found if found.shape[1] == 3 else found.expand(-1, 3).contiguous()

    if bake is not None:
        flat = atlas(surface, bake)
        texture = colours(flat.points()).T.view(3, bake, bake).contiguous()
        return Carved(flat.surface, texture=texture, places=flat.places)
    fine = subdivide(surface, detail / voxels) if len(surface.faces) else surface
    return Carved(fine, colours(fine.vertices))
