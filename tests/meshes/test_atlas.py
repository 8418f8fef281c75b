"""The flat layout of a mesh on a texture."""

import pytest
import torch
from conftest import tetrahedron

from torchtex.meshes.atlas import atlas
from torchtex.meshes.mesh import Mesh

TETRAHEDRON = tetrahedron()


@pytest.mark.parametrize("size", [16, 37, 64])
def test_the_atlas_holds_the_place_of_every_texel(size: int) -> None:
    flat = atlas(TETRAHEDRON, size)
    points = flat.points().view(size, size, 3)
    a, b, c = TETRAHEDRON.vertices[TETRAHEDRON.faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    offset = ((points - a[flat.face]) * normal[flat.face]).sum(-1)
    assert offset.abs().max() < 1e-4  # each texel lies in the plane of its triangle
    assert set(flat.face.flatten().tolist()) == {0, 1, 2, 3}


def test_reading_the_atlas_between_texels_gives_the_place_on_the_triangle() -> None:
    size = 48
    flat = atlas(TETRAHEDRON, size)
    assert flat.mesh.uv is not None
    picture = flat.points().view(size, size, 3)
    generator = torch.Generator().manual_seed(0)
    for number in range(4):
        shares = torch.rand(200, 3, generator=generator) + 1e-3
        shares = shares / shares.sum(1, keepdim=True)
        corners = slice(3 * number, 3 * number + 3)
        at = shares @ (flat.mesh.uv[corners] * size) - 0.5
        low = at.floor().long()
        t = (at - low)[:, :, None]
        y, x = low.unbind(1)
        rows = [torch.lerp(picture[y + k, x], picture[y + k, x + 1], t[:, 1]) for k in (0, 1)]
        found = torch.lerp(rows[0], rows[1], t[:, 0])
        assert torch.allclose(found, shares @ flat.mesh.vertices[corners], atol=1e-4)


def test_an_atlas_that_is_too_small_or_of_nothing() -> None:
    with pytest.raises(ValueError, match="bake=8 is too small for 4 triangles; choose at least 16"):
        atlas(TETRAHEDRON, 8)
    atlas(TETRAHEDRON, 16)
    with pytest.raises(ValueError, match="bake: the mesh has no faces"):
        atlas(Mesh(torch.eye(3), torch.zeros(0, 3).long()), 64)
