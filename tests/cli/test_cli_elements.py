"""The command density: results, repeat, sentences for bad input."""

import json
from pathlib import Path

import pytest
import torch
from conftest import Done, Run, noise, pixels, refused

from torchtex import image as images
from torchtex.layers.elements import find_elements
from torchtex.recipes.density import density

pytest.importorskip("skimage")
pytest.importorskip("sklearn")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a meadow, masks and maps, which is the current one."""
    monkeypatch.chdir(tmp_path)
    image = 0.2 + 0.1 * noise(3, 44, 52).float()
    where = torch.zeros(1, 44, 52)
    for row, col in ((8, 10), (10, 34), (30, 16)):
        image[:2, row : row + 7, col : col + 7] = 0.9
        where[:, row : row + 7, col : col + 7] = 1.0
    images.save("meadow.png", image)
    images.save("mask.png", where)
    images.save("ground.png", 0.1 * noise(3, 40, 40).float())
    half = torch.zeros(1, 44, 52)
    half[:, :, 26:] = 1.0
    images.save("half.png", half)
    images.save("black.png", torch.zeros(1, 44, 52))
    images.save("small.png", torch.ones(1, 9, 9))
    return tmp_path


def test_density_is_the_recipe_and_can_be_repeated(run: Run, here: Path) -> None:
    line = ("density", "meadow.png", "--amount", 2, "--plain", "--seed", 3, "-o", "x.png")
    line = (*line, "--preview", "p.png", "--labels", "l.npz", "--report", "r.json", "--quiet")
    assert run(*line) == Done(0, "x.png\n", "")
    image = pixels("meadow.png")
    elements = find_elements(image, seed=3)
    wanted = density(image, 2.0, elements=elements, poisson=False, seed=3)
    assert torch.allclose(pixels("x.png"), wanted.texture, atol=0.5 / 255 + 1e-6)
    about = json.loads(Path("r.json").read_text())
    assert (about["settings"]["before"], about["settings"]["after"]) == (3, 6)
    assert torch.allclose(pixels("p.png"), elements.picture(image), atol=0.5 / 255 + 1e-6)
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    assert run("apply", "l.npz", "meadow.png", "-o", "z.png").code == 0
    assert torch.equal(pixels("z.png"), pixels("x.png"))


def test_options_reach_the_recipe(run: Run, here: Path) -> None:
    line = ("density", "meadow.png", "--map", "half.png", "--high", 3, "--mask", "mask.png")
    line = (*line, "--ground", "ground.png", "--gap", 1, "--no-turn", "-o", "x.png", "--quiet")
    assert run(*line).code == 0
    image = pixels("meadow.png")
    wanted = density(
        image,
        3.0 * pixels("half.png")[0],
        elements=find_elements(image, pixels("mask.png")[0] > 0.5),
        ground=pixels("ground.png"),
        gap=1,
        turn=False,
    )
    assert torch.allclose(pixels("x.png"), wanted.texture, atol=0.5 / 255 + 1e-6)
    line = ("density", "meadow.png", "--amount", 1, "--size", "60x70", "-o", "y.png", "--quiet")
    assert run(*line).code == 0
    assert pixels("y.png").shape == (3, 60, 70)


@pytest.mark.parametrize(
    ("words", "arguments"),
    [
        ("give one of them", ()),
        ("give one of them", ("--amount", "1", "--map", "half.png")),
        ("map='small.png' has 9x9 pixels", ("--map", "small.png")),
        ("amount=-1 must lie in 0..1000", ("--amount", "-1")),
        ("new elements fit", ("--amount", "40")),
        ("mask='small.png'", ("--amount", "2", "--mask", "small.png")),
        ("mask", ("--amount", "2", "--mask", "black.png")),
        ("at='x' is not ROW,COL", ("--amount", "2", "--at", "x")),
        ("at=(99, 1) lies outside", ("--amount", "2", "--at", "99,1")),
        ("colors=1", ("--amount", "2", "--colors", "1")),
        ("least=0", ("--amount", "2", "--least", "0")),
        ("gap=-1", ("--amount", "2", "--gap", "-1")),
        ("ground='no.png'", ("--amount", "0", "--ground", "no.png")),
        ("size='0x4'", ("--amount", "1", "--size", "0x4")),
    ],
)
def test_bad_input_is_one_sentence(
    run: Run, here: Path, words: str, arguments: tuple[str, ...]
) -> None:
    refused(run, here, words, "density", "meadow.png", *arguments, "-o", "x.png", "--quiet")


def test_the_preview_shows_what_was_refused(run: Run, here: Path) -> None:
    row, col = torch.meshgrid(torch.arange(84), torch.arange(80), indexing="ij")
    between = 0.2 + 0.3 * ((row // 2 + col // 2) % 2)
    heap = torch.where((row % 28 < 9) & (col % 8 < 7), 0.9, between)[None]
    images.save("heap.png", heap)
    images.save("light.png", (heap > 0.8).float())
    line = ("density", "heap.png", "--amount", 2, "--mask", "light.png", "--preview", "p.png")
    done = run(*line, "-o", "x.png", "--quiet")
    assert done.code == 2
    assert "find them by at, mask or another number of colors" in done.err
    assert pixels("p.png").shape == (3, 84, 80)
    assert not Path("x.png").exists()
