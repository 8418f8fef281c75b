"""The commands fill and mix: results, repeating, sentences for bad input."""

from pathlib import Path

import pytest
import torch
from conftest import Run, pixels, refused, stripes

from torchtex import image as images


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a photo, masks and maps, which is the current one."""
    monkeypatch.chdir(tmp_path)
    images.save("photo.png", stripes(48, 56).float())
    images.save("other.png", stripes(48, 48, seed=2).float().flip(2))
    images.save("grey.png", stripes(48, 48, 1).float())
    hole = torch.zeros(1, 48, 56)
    hole[:, 16:30, 20:36] = 1
    images.save("hole.png", hole)
    images.save("none.png", torch.zeros(1, 48, 56))
    images.save("all.png", torch.ones(1, 48, 56))
    images.save("small.png", torch.ones(1, 20, 20))
    images.save("ramp.png", torch.linspace(0, 1, 56).expand(1, 40, 56))
    return tmp_path


def test_fill_keeps_the_known_and_can_be_repeated(run: Run, here: Path) -> None:
    line = ("fill", "photo.png", "--mask", "hole.png", "--quiet")
    assert run(*line, "-o", "x.png", "--labels", "x.npz", "--seams", "s.png").code == 0
    known = pixels("hole.png")[0] < 0.5
    assert torch.equal(pixels("x.png")[:, known], pixels("photo.png")[:, known])
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    assert run(*line, "-o", "plain.png", "--plain", "--labels", "p.npz").code == 0
    assert run("apply", "p.npz", "photo.png", "-o", "z.png").code == 0
    assert torch.equal(pixels("z.png"), pixels("plain.png"))


def test_mix_follows_the_map_and_can_be_repeated(run: Run, here: Path) -> None:
    line = ("mix", "photo.png", "other.png", "--weights", "ramp.png", "--quiet")
    assert run(*line, "-o", "x.png", "--size", "40x64").code == 0
    assert pixels("x.png").shape == (3, 40, 64)
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("none.png", "fill photo.png --mask none.png"),
        ("mask is True everywhere", "fill photo.png --mask all.png"),
        ("20 x 20", "fill photo.png --mask small.png"),
        ("missing.png", "fill photo.png --mask missing.png"),
        ("offsets=0", "fill photo.png --mask hole.png --offsets 0"),
        ("border=-1", "fill photo.png --mask hole.png --border=-1"),
        ("detail=-1", "fill photo.png --mask hole.png --detail=-1"),
        ("seed=-1", "fill photo.png --mask hole.png --seed=-1"),
        ("give at least two", "mix photo.png --weights ramp.png"),
        ("2 maps given for 3", "mix photo.png other.png grey.png --weights all.png "
                               "--weights none.png"),
        ("20x20", "mix photo.png other.png --weights ramp.png --weights small.png"),
        ("size='4'", "mix photo.png other.png --weights ramp.png --size 4"),
        ("weight=-1", "mix photo.png other.png --weights ramp.png --weight=-1"),
        ("boundary='round'", "mix photo.png other.png --weights ramp.png --boundary round"),
    ],
)  # fmt: skip
def test_bad_input(run: Run, here: Path, words: str, line: str) -> None:
    refused(run, here, words, *line.split(), "-o", "bad.png", "--quiet")
