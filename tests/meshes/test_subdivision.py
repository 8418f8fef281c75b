"""Smaller triangles: the same surface without cracks."""

from dataclasses import replace

import pytest
import torch
from conftest import noise, tetrahedron

from torchtex.meshes.mesh import Mesh
from torchtex.meshes.subdivision import subdivide

TETRAHEDRON = tetrahedron()


def area(surface: Mesh) -> torch.Tensor:
    a, b, c = surface.vertices[surface.faces].unbind(1)
    return torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2


@pytest.mark.parametrize("longest", [2.0, 0.7, 0.31])
def test_subdivision_keeps_the_surface_and_its_orientation(longest: float) -> None:
    fine = subdivide(TETRAHEDRON, longest)
    edges = fine.vertices[fine.faces] - fine.vertices[fine.faces.roll(-1, 1)]
    assert edges.norm(dim=2).max() <= longest * 1.001
    assert torch.allclose(area(fine), area(TETRAHEDRON))
    assert fine.closed  # no cracks
    a, b, c = fine.vertices[fine.faces].unbind(1)
    assert bool(((torch.linalg.cross(b - a, c - a) * (a + b + c)).sum(1) > 0).all())
    assert fine.normals is not None
    assert torch.allclose(fine.normals.norm(dim=1), torch.ones(len(fine.normals)))


def test_subdivision_of_long_and_short_edges_leaves_no_cracks() -> None:
    stretched = TETRAHEDRON.vertices * torch.tensor([5.0, 1.0, 0.2])
    fine = subdivide(replace(TETRAHEDRON, vertices=stretched), 0.4)
    assert fine.closed
    assert torch.equal(subdivide(TETRAHEDRON, 9.0).faces, TETRAHEDRON.faces)


def test_too_many_triangles_are_refused() -> None:
    with pytest.raises(ValueError, match="detail: more than 1000 triangles"):
        subdivide(TETRAHEDRON, 0.01, most=1000)


def test_what_vertices_have_is_halfway_between_them() -> None:
    body = replace(tetrahedron(), colors=noise(4, 3, dtype=torch.float32))
    body = replace(body, places=2 * body.vertices + 1)
    fine = subdivide(body, 0.8)
    assert fine.places is not None
    assert fine.colors is not None
    assert torch.allclose(fine.places, 2 * fine.vertices + 1, atol=1e-6)
    assert len(fine.colors) == len(fine.vertices)
