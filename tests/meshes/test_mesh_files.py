"""Files of meshes: what is written comes back, with materials that viewers show well."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import noise, tetrahedron

from torchtex.meshes.atlas import atlas
from torchtex.meshes.files import check_mesh_path, read_mesh, save_mesh
from torchtex.meshes.formats import from_linear, to_linear
from torchtex.meshes.mesh import Mesh
from torchtex.meshes.shapes import sphere

TETRAHEDRON = tetrahedron()


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".obj"])
def test_colours_at_vertices_come_back(tmp_path: Path, suffix: str) -> None:
    import trimesh

    path, colors = tmp_path / f"m{suffix}", noise(4, 3, dtype=torch.float32)
    save_mesh(path, replace(TETRAHEDRON, colors=colors))
    again = read_mesh(path)
    assert torch.allclose(again.vertices, TETRAHEDRON.vertices, atol=1e-5)
    assert torch.equal(again.faces, TETRAHEDRON.faces)
    assert again.normals is not None
    assert again.colors is not None
    assert TETRAHEDRON.normals is not None
    assert torch.allclose(again.normals, TETRAHEDRON.normals, atol=1e-4)
    assert (again.colors - colors).abs().max() < 0.003
    if suffix != ".glb":  # whose colours are amounts of light
        found = trimesh.load(str(path), force="mesh", process=False).visual.vertex_colors[:, :3]
        assert np.abs(found / 255 - colors.numpy()).max() < 0.005
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


def test_a_texture_comes_back_from_a_glb(tmp_path: Path) -> None:
    import trimesh

    flat, texture = atlas(TETRAHEDRON, 16), noise(3, 16, 16, dtype=torch.float32)
    save_mesh(tmp_path / "m.glb", replace(flat.mesh, texture=texture))
    found = trimesh.load(str(tmp_path / "m.glb"), force="mesh", process=False)
    pixels = np.asarray(found.visual.material.baseColorTexture.convert("RGB")) / 255
    assert np.abs(pixels.transpose(2, 0, 1) - texture.numpy()).max() < 0.005
    uv = torch.tensor(np.array(found.visual.uv)).float()
    assert flat.mesh.uv is not None
    assert flat.mesh.normals is not None
    assert torch.allclose(torch.stack([1 - uv[:, 1], uv[:, 0]], 1), flat.mesh.uv, atol=1e-5)
    again = read_mesh(tmp_path / "m.glb")
    assert again.normals is not None
    assert again.texture is not None
    assert again.uv is not None
    assert torch.allclose(again.normals, flat.mesh.normals, atol=1e-4)
    assert torch.allclose(again.uv, flat.mesh.uv, atol=1e-5)
    assert (again.texture - texture).abs().max() < 0.003


def test_an_obj_has_its_texture_beside_it(tmp_path: Path) -> None:
    flat, texture = atlas(TETRAHEDRON, 16), noise(3, 16, 16, dtype=torch.float32)
    save_mesh(tmp_path / "m.obj", replace(flat.mesh, texture=texture))
    found = sorted(item.name for item in tmp_path.iterdir())
    assert found == ["m.mtl", "m.obj", "m_texture.png"]
    again = read_mesh(tmp_path / "m.obj")
    assert again.texture is not None
    assert again.uv is not None
    assert again.normals is not None
    assert (again.texture - texture).abs().max() < 0.003
    assert flat.mesh.uv is not None
    corners = [mesh.uv[mesh.faces] for mesh in (again, flat.mesh) if mesh.uv is not None]
    assert torch.allclose(*corners, atol=1e-5)
    assert torch.allclose(
        again.vertices[again.faces], flat.mesh.vertices[flat.mesh.faces], atol=1e-5
    )


def test_a_glb_has_a_rough_white_material_and_colours_in_linear_light(tmp_path: Path) -> None:
    colors = torch.tensor([[0.0, 0.5, 1.0]]).expand(4, 3)
    save_mesh(tmp_path / "m.glb", replace(TETRAHEDRON, colors=colors))
    content = (tmp_path / "m.glb").read_bytes()
    assert int.from_bytes(content[8:12], "little") == len(content)
    size = int.from_bytes(content[12:16], "little")
    about, binary = json.loads(content[20 : 20 + size]), content[28 + size :]
    (material,) = about["materials"]
    surface = material["pbrMetallicRoughness"]
    assert surface == {
        "baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 0.9,
    }  # fmt: skip
    (primitive,) = about["meshes"][0]["primitives"]
    assert primitive["material"] == 0
    accessor = about["accessors"][primitive["attributes"]["COLOR_0"]]
    view = about["bufferViews"][accessor["bufferView"]]
    stored = np.frombuffer(binary, "<f4", 12, view["byteOffset"]).reshape(4, 3)
    assert (accessor["componentType"], accessor["type"]) == (5126, "VEC3")
    assert np.abs(stored - [0, 0.2140, 1]).max() < 1e-4
    place = about["accessors"][primitive["attributes"]["POSITION"]]
    assert place["min"] == [-1, -1, -1]
    assert place["max"] == [1, 1, 1]


def test_light_and_colours_are_inverse() -> None:
    colors = noise(50, 3)
    assert torch.allclose(from_linear(to_linear(colors)), colors, atol=1e-9)


@pytest.mark.parametrize("suffix", [".glb", ".ply"])
def test_points_without_faces(tmp_path: Path, suffix: str) -> None:
    places, colors = noise(9, 3, dtype=torch.float32), noise(9, 3, seed=1, dtype=torch.float32)
    points = Mesh(places, torch.zeros(0, 3).long(), colors=colors)
    save_mesh(tmp_path / f"p{suffix}", points)
    again = read_mesh(tmp_path / f"p{suffix}")
    assert len(again.faces) == 0
    assert torch.allclose(again.vertices, points.vertices, atol=1e-6)
    assert again.colors is not None  # of a .glb they are read as light in 8 bits
    shades = [to_linear(each) if suffix == ".glb" else each for each in (again.colors, colors)]
    assert (shades[0] - shades[1]).abs().max() < 0.003
    with pytest.raises(ValueError, match="cannot hold coloured points"):
        save_mesh(tmp_path / "p.obj", points)


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
    assert found.normals is not None
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


def test_files_of_others_keep_colours_and_textures(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    ball = sphere(6)
    colors = ((ball.vertices + 1) * 127).round().byte().numpy()
    made = trimesh.Trimesh(5 * ball.vertices.numpy() + 9, ball.faces.numpy(), process=False)
    made.visual.vertex_colors = colors
    for name in ("a.ply", "a.glb"):
        made.export(tmp_path / name)
        mesh = read_mesh(tmp_path / name)
        assert mesh.colors is not None
        assert torch.allclose(mesh.vertices, 5 * ball.vertices + 9, atol=1e-5)
        shown = to_linear(mesh.colors) if name == "a.glb" else mesh.colors
        assert float((shown * 255 - torch.tensor(colors)[:, :3]).abs().max()) < 1.5
    (tmp_path / "b.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
                                    "f 1/1 2/2 3/3\n")  # fmt: skip
    mesh = read_mesh(tmp_path / "b.obj")
    assert mesh.uv is not None
    assert mesh.uv.tolist() == [[1, 0], [1, 1], [0, 0]]
    (tmp_path / "c.obj").write_text("nothing")
    (tmp_path / "d.ply").write_bytes(b"\0\1")
    for name, words in (("c.obj", "mesh"), ("d.ply", "no mesh that can be read"),
                        ("e.obj", "no such file"), ("f.png", "must end in")):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            read_mesh(tmp_path / name)
