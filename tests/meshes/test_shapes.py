"""Shapes by name: outwards, closed, and with textures that are not mirrored."""

import pytest
import torch

from torchtex.meshes.cubes import cube, cube_cutaway
from torchtex.meshes.mesh import Mesh
from torchtex.meshes.shapes import SHAPES, bowl, cone, cylinder, knot, sphere, torus, vase


@pytest.mark.parametrize("name", list(SHAPES))
def test_things_face_outwards_with_rows_down_and_columns_to_the_right(name: str) -> None:
    mesh = SHAPES[name]()
    assert mesh.normals is not None
    assert mesh.uv is not None
    corners = mesh.vertices[mesh.faces].double()
    a, b, c = corners.unbind(1)
    face = torch.linalg.cross(b - a, c - a)
    area = face.norm(dim=1)
    smooth = mesh.normals[mesh.faces].double().mean(1)
    assert bool(((face * smooth).sum(1) >= -1e-9).all())
    assert torch.allclose(mesh.normals.norm(dim=1), torch.ones(len(mesh.normals)), atol=1e-3)
    p, q, r = mesh.uv[mesh.faces].double().unbind(1)
    first, second = q - p, r - p
    turned = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    assert bool((turned[area > 1e-9] > 0).all())  # no texture is mirrored


@pytest.mark.parametrize(
    "mesh", [sphere(24), torus(24), cube(), cylinder(), cone(), bowl(), knot(), cube_cutaway(0.3)]
)
def test_closed_things_are_closed(mesh: Mesh) -> None:
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    flux = torch.linalg.cross(b - a, c - a).sum(0)
    assert float(flux.abs().max()) < 1e-5
    assert mesh.closed
    volume = float((a * torch.linalg.cross(b, c)).sum() / 6)
    assert volume > 0


def test_a_cut_takes_its_corner_away() -> None:
    mesh = cube_cutaway(0.4, side=2.0)
    assert mesh.places is not None
    assert not bool((mesh.places > 0.6 + 1e-6).all(1).any())
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    volume = float((a * torch.linalg.cross(b, c)).sum() / 6)
    assert volume == pytest.approx(8 * (1 - 0.4**3), rel=1e-5)
    assert torch.allclose((mesh.places - 0.5) * 2, mesh.vertices)
    with pytest.raises(ValueError, match=r"cut=1\.0"):
        cube_cutaway(1.0)


def test_a_vase_stands_upright() -> None:
    low, high = vase().vertices.amin(0), vase().vertices.amax(0)
    assert float(high[1]) == pytest.approx(1)
    assert float(low[1]) == pytest.approx(-1)
    assert float((high + low)[[0, 2]].abs().max()) < 0.01


def test_a_cone_is_not_stretched() -> None:
    mesh = cone()
    assert mesh.uv is not None
    side = mesh.normals[:, 1] > 0  # type: ignore[index]
    faces = mesh.faces[side[mesh.faces].all(1)]
    corners, uv = mesh.vertices[faces].double(), 1.6 * mesh.uv[faces].double()
    there = (corners - corners.roll(1, 1)).norm(dim=2)
    flat = (uv - uv.roll(1, 1)).norm(dim=2)
    assert (there - flat).abs().max() < 1e-3


def test_a_knot_does_not_meet_itself() -> None:
    rows = knot(96).vertices.view(29, 97, 3)[:-1]
    middle = rows.mean(0)
    assert (rows - middle).norm(dim=2).sub(0.15).abs().max() < 1e-3
    apart = torch.cdist(middle, middle)
    step = (torch.arange(97)[:, None] - torch.arange(97)).abs()
    beside = torch.minimum(step, 96 - step) < 12
    assert apart[~beside].min() > 0.32
