"""Meshes: what they may hold, whether they are closed, how they are joined and placed."""

from dataclasses import replace

import pytest
import torch
from conftest import noise, tetrahedron

from torchtex.meshes.cubes import cube
from torchtex.meshes.mesh import Mesh, joined
from torchtex.meshes.placing import centred, wrapped
from torchtex.meshes.shapes import sphere, torus, vase


def test_what_is_watertight() -> None:
    body = tetrahedron()
    assert body.closed
    assert not replace(body, faces=body.faces[1:]).closed
    flipped = body.faces.clone()
    flipped[0] = flipped[0].flip(0)
    assert not replace(body, faces=flipped).closed
    for made in (sphere(8), torus(8), cube()):  # with two vertices at one place along their seams
        assert made.closed
    assert not vase(8).closed
    assert not Mesh(torch.eye(3), torch.zeros(0, 3).long()).closed


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("words", "vertices", "faces"),
    [
        ("no vertices", torch.zeros(0, 3), torch.zeros(0, 3).long()),
        ("NaN or infinite", torch.full((3, 3), torch.nan), torch.tensor([[0, 1, 2]])),
        (r"outside 0\.\.2", torch.eye(3), torch.tensor([[0, 1, 3]])),
    ],
)
def test_what_is_no_mesh(words: str, vertices: torch.Tensor, faces: torch.Tensor) -> None:
    with pytest.raises(ValueError, match=words):
        Mesh(vertices, faces)
    with pytest.raises(ValueError, match="uv has 2 rows for 3"):
        Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.rand(2, 2))


def test_joined_meshes_keep_what_both_have() -> None:
    body = tetrahedron()
    two = joined([body, replace(body, vertices=body.vertices + 5)])
    assert two.closed
    assert two.faces[4:].sub(4).equal(body.faces)
    assert two.normals is not None
    with pytest.raises(ValueError, match="meshes is empty"):
        joined([])


def test_vertices_of_their_own_have_what_they_had() -> None:
    body = replace(tetrahedron(), colors=noise(4, 3, dtype=torch.float32))
    own = body.unshared()
    assert body.colors is not None
    assert own.colors is not None
    assert torch.equal(own.vertices[own.faces], body.vertices[body.faces])
    assert torch.equal(own.colors[own.faces], body.colors[body.faces])
    assert own.closed


def test_a_centred_mesh_fits_and_keeps_its_solid_texture() -> None:
    far = replace(tetrahedron(), vertices=40 * tetrahedron().vertices + 900)
    near = centred(far)
    assert near.vertices.norm(dim=1).max().item() == pytest.approx(1)
    assert near.places is not None
    assert torch.equal(near.places, far.vertices)
    assert torch.allclose(centred(near).vertices, near.vertices, atol=1e-6)


def test_wrapping_has_no_seam_inside_a_triangle_and_no_twist_at_the_poles() -> None:
    ball = wrapped(Mesh(sphere(12).vertices, sphere(12).faces))
    assert ball.uv is not None
    across = ball.uv[ball.faces][..., 1]
    assert float((across.amax(1) - across.amin(1)).max()) <= 2 / 24 + 1e-3
    assert wrapped(ball) is ball
