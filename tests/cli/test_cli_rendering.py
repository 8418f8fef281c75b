"""The command render: results, repeat, sentences for bad input."""

from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Done, Run, noise, pixels, refused

from torchtex import image as images
from torchtex.meshes.files import read_mesh
from torchtex.render.pictures import mesh_picture, texture_picture, volume_picture
from torchtex.render.views import Camera, Light

SMALL = ("--size", "20x24", "--samples", 1, "--quiet")
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a texture, a volume and a mesh, which is the current one."""
    monkeypatch.chdir(tmp_path)
    images.save("tile.png", noise(3, 16, 16).float())
    images.save("floor.png", noise(1, 12, 12).float())
    np.save("solid.npy", noise(3, 6, 6, 6).float().numpy())
    Path("thing.obj").write_text(TRIANGLE)
    Path("bad.obj").write_text("nothing")
    Path("text.png").write_text("no picture")
    return tmp_path


def test_render_is_the_function_and_can_be_repeated(run: Run, here: Path) -> None:
    line = ("render", "tile.png", "--object", "torus", "--tiles", 2, "--normals", 0.5)
    line = (*line, "--ground", "floor.png", "--gloss", 0.3, "--camera", "40,30,5")
    line = (*line, "--light", "10,60,0.9,0.2", *SMALL)
    assert run(*line, "-o", "x.png") == Done(0, "x.png\n", "")
    wanted = texture_picture(
        pixels("tile.png"),
        "torus",
        tiles=2.0,
        normals=0.5,
        ground=pixels("floor.png"),
        gloss=0.3,
        camera=Camera(40.0, 30.0, 5.0, (0.0, -0.02, 0.0)),
        light=Light(10.0, 60.0, 0.9, 0.2),
        size=(20, 24),
        samples=1,
    )
    assert torch.allclose(pixels("x.png"), wanted, atol=0.5 / 255 + 1e-6)
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))


def test_volumes_and_meshes_are_shown(run: Run, here: Path) -> None:
    pytest.importorskip("trimesh")
    small = {"size": (20, 24), "samples": 1, "light": Light()}
    assert run("render", "solid.npy", "--cut", 0.4, *SMALL, "-o", "v.png").code == 0
    volume = torch.from_numpy(np.load("solid.npy"))
    wanted = volume_picture(volume, cut=0.4, **small)  # type: ignore[arg-type]
    assert torch.allclose(pixels("v.png"), wanted, atol=0.5 / 255 + 1e-6)
    assert run("render", "thing.obj", *SMALL, "-o", "m.png").code == 0
    wanted = mesh_picture(read_mesh("thing.obj"), **small)  # type: ignore[arg-type]
    assert torch.allclose(pixels("m.png"), wanted, atol=0.5 / 255 + 1e-6)
    line = ("render", "tile.png", "--object", "thing.obj", *SMALL)
    assert run(*line, "-o", "t.png").code == 0
    for name in ("v", "m", "t"):
        assert run("repeat", f"{name}.png", "-o", "y.png", "--quiet").code == 0
        assert torch.equal(pixels(f"{name}.png"), pixels("y.png"))


@pytest.mark.parametrize(
    ("words", "arguments"),
    [
        ("object='teapot' is unknown; choose sphere", ("tile.png", "--object", "teapot")),
        ("object='no.obj': there is no such file", ("tile.png", "--object", "no.obj")),
        ("source='no.obj'", ("no.obj",)),
        ("source='text.png'", ("text.png",)),
        ("is no file and no bundled exemplar", ("brickz",)),
        ("ground='text.png'", ("tile.png", "--ground", "text.png")),
        ("tiles=0.0 must be above 0", ("tile.png", "--tiles", "0")),
        ("cut=1.0 must be", ("solid.npy", "--cut", "1")),
        ("camera='3' must be", ("tile.png", "--camera", "3")),
        ("elevation=95.0", ("tile.png", "--camera", "3,95")),
        ("light='a,b' must be", ("tile.png", "--light", "a,b")),
        ("cut=0.3 changes nothing of a texture", ("tile.png", "--cut", "0.3")),
        ("ground='floor.png' changes nothing of a plane",
         ("tile.png", "--object", "plane", "--ground", "floor.png")),
        ("tiles=2.0 changes nothing of a mesh", ("thing.obj", "--tiles", "2")),
        ("object='cube' changes nothing of a mesh", ("thing.obj", "--object", "cube")),
        ("shadows=False changes nothing of a volume", ("solid.npy", "--no-shadows")),
        ("gloss=0.2 changes nothing of a volume", ("solid.npy", "--gloss", "0.2")),
        ("size='12'", ("tile.png", "--size", "12")),
        ("samples=0", ("tile.png", "--samples", "0")),
    ],
)  # fmt: skip
def test_bad_input_is_one_sentence(
    run: Run, here: Path, words: str, arguments: tuple[str, ...]
) -> None:
    pytest.importorskip("trimesh")
    refused(run, here, words, "render", *arguments, "-o", "x.png", "--quiet")
