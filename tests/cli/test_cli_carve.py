"""The command carve: what it writes and tells, and bad input."""

import json
import sys
from pathlib import Path

import pytest
import torch
from conftest import Done, Run, refused

from torchtex import image as images
from torchtex.meshes.files import read_mesh
from torchtex.volumes.files import save_volume


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with volumes and meshes, which is the current one."""
    monkeypatch.chdir(tmp_path)
    generator = torch.Generator().manual_seed(0)
    volume = torch.rand(3, 6, 6, 6, generator=generator)
    save_volume("v.npy", volume)
    save_volume("slices", volume)
    save_volume("seven.npy", torch.rand(7, 6, 6, 6, generator=generator))
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    Path("open.obj").write_text(corners + "f 1 2 3\n")
    Path("closed.obj").write_text(corners + "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    Path("points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 0\n1 2 3\n"
    )
    Path("nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    Path("text.ply").write_text("no mesh")
    Path("text.npy").write_text("no volume")
    Path("mesh.blend").write_text("no mesh")
    images.save("picture.png", volume[:, 0])
    Path("empty").mkdir()
    return tmp_path


@pytest.mark.parametrize("volume", ["v.npy", "slices"])
@pytest.mark.parametrize("output", ["x.glb", "x.ply", "x.obj"])
def test_a_closed_mesh(run: Run, here: Path, volume: str, output: str) -> None:
    done = run("carve", volume, "--mesh", "closed.obj", "-o", output, "--report", "r.json")
    assert done == Done(0, f"{output}\n", "")
    found = read_mesh(output)
    assert found.closed
    assert len(found.faces) > 4
    about = json.loads(Path("r.json").read_text())
    assert about["settings"]["faces"] == len(found.faces)
    assert about["settings"]["watertight"] is True


@pytest.mark.parametrize(
    "mesh", ["sphere", "torus", "vase", "cube", "cylinder", "cone", "bowl", "knot", "cloth"]
)
def test_built_in_meshes(run: Run, here: Path, mesh: str) -> None:
    done = run("carve", "v.npy", "--mesh", mesh, "-o", "x.glb", "--quiet", "--scale", "0.5")
    assert done == Done(0, "x.glb\n", "")
    assert len(read_mesh("x.glb").faces)


def test_a_baked_texture(run: Run, here: Path) -> None:
    assert run("carve", "v.npy", "--mesh", "closed.obj", "-o", "x.glb", "--bake", "64").code == 0
    assert len(read_mesh("x.glb").faces) == 4
    assert b"image/png" in Path("x.glb").read_bytes()


def test_a_baked_texture_beside_an_obj(run: Run, here: Path) -> None:
    line = ("carve", "v.npy", "--mesh", "closed.obj", "--bake", "64", "-o")
    assert run(*line, "x.obj") == Done(0, "x.obj\n", "")
    assert Path("x.mtl").exists()
    texture = read_mesh("x.obj").texture
    assert texture is not None
    assert texture.shape == (3, 64, 64)
    Path("y.mtl").mkdir()
    refused(run, here, "output='y.mtl' is no ordinary file", *line, "y.obj")


def test_what_is_not_watertight_is_told(run: Run, here: Path) -> None:
    done = run("carve", "v.npy", "--mesh", "open.obj", "-o", "x.glb")
    assert done.err == "mesh='open.obj' is not watertight; it is carved as it is\n"
    assert done.code == 0
    assert run("carve", "v.npy", "--mesh", "open.obj", "-o", "x.glb", "--quiet").err == ""


def test_points_without_faces_are_told(run: Run, here: Path) -> None:
    done = run("carve", "v.npy", "--mesh", "points.ply", "-o", "x.ply")
    assert done == Done(0, "x.ply\n", "mesh='points.ply' has no faces; its points are coloured\n")
    assert len(read_mesh("x.ply").vertices) == 2


def test_shift_and_scale_change_colours(run: Run, here: Path) -> None:
    options = ("carve", "v.npy", "--mesh", "points.ply", "--quiet", "-o")
    for name, more in (("a", ()), ("b", ("--shift", "1,-2.5,3")), ("c", ("--shift", "6,6,6"))):
        assert run(*options, f"{name}.ply", *more).code == 0
    a, b, c = (Path(f"{name}.ply").read_bytes() for name in "abc")
    assert a != b
    assert a == c  # it repeats


def test_a_report_says_how_to_carve_it_again(run: Run, here: Path) -> None:
    line = ("carve", "v.npy", "--mesh", "closed.obj", "--shift", "1,0,2", "--report", "r.json")
    assert run(*line, "-o", "x.glb").code == 0
    assert run("repeat", "r.json", "-o", "y.glb", "--quiet") == Done(0, "y.glb\n", "")
    assert Path("x.glb").read_bytes() == Path("y.glb").read_bytes()
    refused(run, here, "would overwrite", "repeat", "r.json", "-o", "r.json", "--quiet")


GOOD = ("v.npy", "--mesh", "closed.obj", "-o", "x.glb")
BAD: list[tuple[str, tuple[str, ...]]] = [
    ("mesh='ball' is no built-in mesh", ("v.npy", "--mesh", "ball", "-o", "x.glb")),
    ("mesh='shpere' is no built-in mesh and no file of one; did you mean sphere",
     ("v.npy", "--mesh", "shpere", "-o", "x.glb")),
    ("mesh='mesh.blend' must end in", ("v.npy", "--mesh", "mesh.blend", "-o", "x.glb")),
    ("mesh='none.obj': there is no such file", ("v.npy", "--mesh", "none.obj", "-o", "x.glb")),
    ("mesh='text.ply' is no mesh", ("v.npy", "--mesh", "text.ply", "-o", "x.glb")),
    ("NaN or infinite", ("v.npy", "--mesh", "nan.obj", "-o", "x.glb")),
    ("volume='text.npy' cannot be read", ("text.npy", *GOOD[1:])),
    ("volume='none.npy': there is no such file", ("none.npy", *GOOD[1:])),
    ("volume='picture.png' must end in", ("picture.png", *GOOD[1:])),
    ("volume='empty' is a folder without pictures", ("empty", *GOOD[1:])),
    ("volume has 7 channels", ("seven.npy", *GOOD[1:])),
    ("output='x.stl' must", (*GOOD[:-1], "x.stl")),
    ("output='no/x.glb': there is no folder", (*GOOD[:-1], "no/x.glb")),
    ("output='closed.obj' would overwrite", (*GOOD[:-1], "closed.obj")),
    ("cannot hold a texture", (*GOOD[:-1], "x.ply", "--bake", "64")),
    ("cannot hold coloured points", ("v.npy", "--mesh", "points.ply", "-o", "x.obj")),
    ("bake: the mesh has no faces",
     ("v.npy", "--mesh", "points.ply", "-o", "x.glb", "--bake", "64")),
    ("bake=8 is too small for 4 triangles", (*GOOD, "--bake", "8")),
    ("bake=0 must lie in", (*GOOD, "--bake", "0")),
    ("--bake", (*GOOD, "--bake", "large")),
    ("scale=0.0 must be above 0", (*GOOD, "--scale", "0")),
    ("detail=-1.0 must be above 0", (*GOOD, "--detail", "-1")),
    ("detail: more than", (*GOOD, "--scale", "100000")),
    ("shift='1,2' must be", (*GOOD, "--shift", "1,2")),
    ("shift='a,b,c' must be", (*GOOD, "--shift", "a,b,c")),
    ("report='r.txt' must", (*GOOD, "--report", "r.txt")),
]  # fmt: skip


@pytest.mark.parametrize(("words", "arguments"), BAD, ids=[words for words, _ in BAD])
def test_bad_input_gets_one_sentence_and_code_2(
    run: Run, here: Path, words: str, arguments: tuple[str, ...]
) -> None:
    refused(run, here, words, "carve", *arguments)


def test_without_trimesh_it_says_what_to_install(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    refused(run, here, "torchtex[solid]", "carve", *GOOD)
