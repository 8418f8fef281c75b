"""Meshes for carving: reading and writing, division into small triangles, the flat layout."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import noise

from torchtex.render.shapes import sphere, torus, vase
from torchtex.render.solids import cube
from torchtex.volumes.meshes import (
    Surface,
    atlas,
    check_mesh_path,
    read_mesh,
    save_mesh,
    subdivide,
)

CORNERS = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
TETRAHEDRON = Surface(
    CORNERS, torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]), CORNERS / 3**0.5
)


def area(surface: Surface) -> torch.Tensor:
    a, b, c = surface.vertices[surface.faces].unbind(1)
    return torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2


def test_what_is_watertight() -> None:
    assert TETRAHEDRON.closed
    assert not Surface(TETRAHEDRON.vertices, TETRAHEDRON.faces[1:], TETRAHEDRON.normals).closed
    flipped = TETRAHEDRON.faces.clone()
    flipped[0] = flipped[0].flip(0)
    assert not Surface(TETRAHEDRON.vertices, flipped, TETRAHEDRON.normals).closed
    for made in (sphere(8), torus(8), cube()):  # with two vertices at one place along their seams
        assert made.normals is not None
        assert Surface(made.vertices, made.faces, made.normals).closed
    open_ = vase(8)
    assert open_.normals is not None
    assert not Surface(open_.vertices, open_.faces, open_.normals).closed
    assert not Surface(torch.eye(3), torch.zeros(0, 3).long(), torch.eye(3)).closed


@pytest.mark.parametrize("longest", [2.0, 0.7, 0.31])
def test_subdivision_keeps_the_surface_and_its_orientation(longest: float) -> None:
    fine = subdivide(TETRAHEDRON, longest)
    edges = fine.vertices[fine.faces] - fine.vertices[fine.faces.roll(-1, 1)]
    assert edges.norm(dim=2).max() <= longest * 1.001
    assert torch.allclose(area(fine), area(TETRAHEDRON))
    assert fine.closed  # no cracks
    a, b, c = fine.vertices[fine.faces].unbind(1)
    assert bool(((torch.linalg.cross(b - a, c - a) * (a + b + c)).sum(1) > 0).all())
    assert torch.allclose(fine.normals.norm(dim=1), torch.ones(len(fine.normals)))


def test_subdivision_of_long_and_short_edges_leaves_no_cracks() -> None:
    stretched = TETRAHEDRON.vertices * torch.tensor([5.0, 1.0, 0.2])
    fine = subdivide(Surface(stretched, TETRAHEDRON.faces, TETRAHEDRON.normals), 0.4)
    assert fine.closed
    assert torch.equal(subdivide(TETRAHEDRON, 9.0).faces, TETRAHEDRON.faces)


def test_too_many_triangles_are_refused() -> None:
    with pytest.raises(ValueError, match="detail: more than 1000 triangles"):
        subdivide(TETRAHEDRON, 0.01, most=1000)


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
    picture = flat.points().view(size, size, 3)
    generator = torch.Generator().manual_seed(0)
    for number in range(4):
        shares = torch.rand(200, 3, generator=generator) + 1e-3
        shares = shares / shares.sum(1, keepdim=True)
        corners = slice(3 * number, 3 * number + 3)
        at = shares @ flat.places[corners] - 0.5
        low = at.floor().long()
        t = (at - low)[:, :, None]
        y, x = low.unbind(1)
        rows = [torch.lerp(picture[y + k, x], picture[y + k, x + 1], t[:, 1]) for k in (0, 1)]
        found = torch.lerp(rows[0], rows[1], t[:, 0])
        assert torch.allclose(found, shares @ flat.surface.vertices[corners], atol=1e-4)


def test_an_atlas_that_is_too_small_or_of_nothing() -> None:
    with pytest.raises(ValueError, match="bake=8 is too small for 4 triangles; choose at least 16"):
        atlas(TETRAHEDRON, 8)
    atlas(TETRAHEDRON, 16)
    with pytest.raises(ValueError, match="bake: the mesh has no faces"):
        atlas(Surface(torch.eye(3), torch.zeros(0, 3).long(), torch.eye(3)), 64)


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".obj"])
def test_colours_at_vertices_come_back(tmp_path: Path, suffix: str) -> None:
    import trimesh

    path, colors = tmp_path / f"m{suffix}", noise(4, 3, dtype=torch.float32)
    save_mesh(path, TETRAHEDRON, colors=colors)
    again = read_mesh(path)
    assert torch.allclose(again.vertices, TETRAHEDRON.vertices, atol=1e-5)
    assert torch.equal(again.faces, TETRAHEDRON.faces)
    assert torch.allclose(again.normals, TETRAHEDRON.normals, atol=1e-4)
    found = trimesh.load(str(path), force="mesh", process=False).visual.vertex_colors[:, :3]
    assert np.abs(found / 255 - colors.numpy()).max() < 0.005
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


def test_a_texture_comes_back_from_a_glb(tmp_path: Path) -> None:
    import trimesh

    flat, texture = atlas(TETRAHEDRON, 16), noise(3, 16, 16, dtype=torch.float32)
    save_mesh(tmp_path / "m.glb", flat.surface, texture=texture, places=flat.places)
    found = trimesh.load(str(tmp_path / "m.glb"), force="mesh", process=False)
    pixels = np.asarray(found.visual.material.baseColorTexture.convert("RGB")) / 255
    assert np.abs(pixels.transpose(2, 0, 1) - texture.numpy()).max() < 0.005
    uv = torch.tensor(np.array(found.visual.uv)).float()
    assert torch.allclose(torch.stack([1 - uv[:, 1], uv[:, 0]], 1) * 16, flat.places, atol=1e-4)
    assert torch.allclose(read_mesh(tmp_path / "m.glb").normals, flat.surface.normals, atol=1e-4)


@pytest.mark.parametrize("suffix", [".glb", ".ply"])
def test_points_without_faces(tmp_path: Path, suffix: str) -> None:
    points = Surface(noise(9, 3, dtype=torch.float32), torch.zeros(0, 3).long(), torch.zeros(9, 3))
    save_mesh(tmp_path / f"p{suffix}", points, colors=noise(9, 3, dtype=torch.float32))
    again = read_mesh(tmp_path / f"p{suffix}")
    assert len(again.faces) == 0
    assert torch.allclose(again.vertices, points.vertices, atol=1e-6)
    with pytest.raises(ValueError, match="cannot hold coloured points"):
        save_mesh(tmp_path / "p.obj", points, colors=torch.zeros(9, 3))


def test_parts_of_a_scene_are_joined_where_they_stand(tmp_path: Path) -> None:
    import trimesh

    box = trimesh.creation.box()
    scene = trimesh.Scene()
    scene.add_geometry(box)
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    mirrored = trimesh.transformations.scale_matrix(-1, direction=[0, 1, 0])
    scene.add_geometry(
        box, transform=mirrored @ trimesh.transformations.translation_matrix([6, 0, 0])
    )
    (tmp_path / "two.glb").write_bytes(scene.export(file_type="glb"))
    found = read_mesh(tmp_path / "two.glb")
    assert found.vertices[:, 0].amin().item() == -0.5
    assert found.vertices[:, 0].amax().item() == 6.5
    assert found.closed
    assert len(found.faces) == 36
    outwards = found.vertices - torch.tensor([3.0, 0, 0]) * (found.vertices[:, :1] / 3).round()
    assert bool(((found.normals * outwards).sum(1) > 0).all())


def test_bad_files_get_a_sentence(tmp_path: Path) -> None:
    for name in ("text.ply", "text.glb", "text.stl", "empty.obj"):
        (tmp_path / name).write_text("no mesh" if name != "empty.obj" else "")
        with pytest.raises(ValueError, match=r"is no mesh that can be read"):
            read_mesh(tmp_path / name)
    with pytest.raises(ValueError, match="there is no such file"):
        read_mesh(tmp_path / "none.ply")
    with pytest.raises(ValueError, match=r"must end in \.ply"):
        read_mesh(tmp_path / "scene.blend")
    (tmp_path / "nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match="NaN or infinite"):
        read_mesh(tmp_path / "nan.obj")


@pytest.mark.parametrize(
    ("words", "name", "options"),
    [
        (r"must end in \.glb, \.ply or \.obj", "a.stl", {}),
        ("cannot hold a texture", "a.ply", {"baked": True}),
        ("cannot hold a texture", "a.obj", {"baked": True}),
        ("there is no folder", "no/a.glb", {}),
    ],
)
def test_bad_names_get_a_sentence(
    tmp_path: Path, words: str, name: str, options: dict[str, bool]
) -> None:
    with pytest.raises(ValueError, match=words):
        check_mesh_path(tmp_path / name, **options)


def test_without_trimesh_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    (tmp_path / "a.ply").write_text("ply")
    with pytest.raises(ImportError, match=r"torchtex\[solid\]"):
        read_mesh(tmp_path / "a.ply")


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
        Surface(vertices, faces, torch.zeros_like(vertices))
