"""The command marble: results, repeat, sentences for bad input."""

import json
from pathlib import Path

import pytest
import torch
from conftest import Done, Run, noise, pixels, refused

from torchtex import image as images
from torchtex.layers.marbling import marble
from torchtex.layers.tines import Tine, Wave
from torchtex.layers.whirls import Drop


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two tiles and a design, which is the current one."""
    monkeypatch.chdir(tmp_path)
    images.save("tile.png", noise(3, 32, 40).float())
    images.save("grey.png", noise(1, 24, 24).float())
    Path("design.json").write_text('[{"operation": "wave", "amplitude": 0.1}]')
    Path("text.png").write_text("no picture")
    return tmp_path


def test_marble_is_the_function_and_can_be_repeated(run: Run, here: Path) -> None:
    line = ("marble", "tile.png", "--op", "tine:45,shift=0.3", "--operations", "design.json")
    line = (*line, "--boundary", "periodic", "-o", "x.png", "--report", "r.json", "--quiet")
    assert run(*line) == Done(0, "x.png\n", "")
    wanted = marble(pixels("tile.png"), [Wave(0.1), Tine(45.0, shift=0.3)], periodic=True)
    assert torch.allclose(pixels("x.png"), wanted, atol=0.5 / 255 + 1e-6)
    about = json.loads(Path("r.json").read_text())
    assert [item["operation"] for item in about["settings"]["operations"]] == ["wave", "tine"]
    assert set(about["files"]) == {"tile.png", "design.json"}
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    Path("design.json").write_text('[{"operation": "wave", "amplitude": 0.2}]')
    assert "changed" in run("repeat", "x.png", "-o", "y.png", "--quiet").err


def test_options_reach_the_function(run: Run, here: Path) -> None:
    line = ("marble", "grey.png", "--op", "drop:color=#ff0000", "--undo", "--size", "30x20")
    line = (*line, "--samples", 2, "--degree", 1, "--bits", 16, "-o", "x.png", "--quiet")
    assert run(*line).code == 0
    wanted = marble(
        pixels("grey.png"), [Drop(color=(0.299,))], undo=True, size=(30, 20), samples=2, degree=1
    )
    assert torch.allclose(pixels("x.png"), wanted, atol=1e-4)


@pytest.mark.parametrize(
    ("words", "arguments"),
    [
        ("op: none given", ("tile.png",)),
        ("did you mean tine", ("tile.png", "--op", "tyne")),
        ("operations='no.json' cannot be read", ("tile.png", "--operations", "no.json")),
        ("texture='text.png'", ("text.png", "--op", "tine")),
        ("must be HEIGHTxWIDTH", ("tile.png", "--op", "tine", "--size", "0x3")),
        ("boundary='round' is unknown", ("tile.png", "--op", "tine", "--boundary", "round")),
        ("samples=0 must lie", ("tile.png", "--op", "tine", "--samples", "0")),
        ("degree=4 must be", ("tile.png", "--op", "tine", "--degree", "4")),
        ("must be whole", ("tile.png", "--op", "wave:rows=.5", "--boundary", "periodic")),
        ("bits=7", ("tile.png", "--op", "tine", "--bits", "7")),
    ],
)
def test_bad_input_is_one_sentence(
    run: Run, here: Path, words: str, arguments: tuple[str, ...]
) -> None:
    refused(run, here, words, "marble", *arguments, "-o", "x.png", "--quiet")
