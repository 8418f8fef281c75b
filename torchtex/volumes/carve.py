"""Things carved out of a volume of texture: its colours where the surface passes through it."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.meshes.atlas import atlas
from torchtex.meshes.mesh import Mesh
from torchtex.meshes.shapes import shape
from torchtex.meshes.subdivision import subdivide
from torchtex.volumes.files import check_volume

_AT_ONCE = 2**20  # places that are sampled at a time


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
    mesh: Mesh | str,
    *,
    scale: float = 1.0,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    detail: float = 1.0,
    bake: int | None = None,
) -> Mesh:
    """A mesh with the colours of a volume: x runs along its columns, y up its rows, z to its front.

    Args:
        volume: (c, d, h, w) in [0, 1], of one or three channels; it repeats without end.
        mesh: such as one of `read_mesh`, or the name of one of `meshes.shapes.SHAPES`.
        scale: how often the longest side of the volume fits along the longest side of the mesh.
        shift: depth, row and column of the volume at the mesh's corner behind, above and to the
            left, in voxels.
        detail: longest edge of the triangles that get colours at their corners, in voxels.
        bake: side of a texture that holds the colours instead, in pixels; triangles stay.

    Returns:
        The mesh in smaller triangles with `colors`, or baked with `uv` and `texture`; save it by
        `save_mesh`, or see it by `mesh_picture`.

    Raises:
        ValueError: a volume of other channels, an unknown name, or an option out of range.

    Example:
        >>> carve(torch.rand(3, 8, 8, 8), "cube").colors.shape[1]
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
    given = shape(mesh) if isinstance(mesh, str) else mesh
    bare = Mesh(given.vertices, given.faces, normals=given.normals)
    low, high = bare.vertices.amin(0), bare.vertices.amax(0)
    voxels = scale * max(volume.shape[1:]) / float((high - low).max().clamp(min=1e-30))
    start = torch.tensor(shift, dtype=torch.float64)

    def colours(points: Tensor) -> Tensor:
        x, y, z = ((points - low).double() * voxels).unbind(1)
        up, front = ((high - low).double() * voxels)[1:]
        places = torch.stack([front - z, up - y, x], 1) + start - 0.5
        found = sample(volume, places)
        return found if found.shape[1] == 3 else found.expand(-1, 3).contiguous()

    if bake is not None:
        flat = atlas(bare, bake)
        texture = colours(flat.points()).T.view(3, bake, bake).contiguous()
        return replace(flat.mesh, texture=texture)
    fine = subdivide(bare, detail / voxels) if len(bare.faces) else bare
    return replace(fine, colors=colours(fine.vertices))
