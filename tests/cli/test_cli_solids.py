"""The command solid: what it writes, going on after an interrupt, sentences for bad input."""

import json
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Run, refused, stripes

from torchtex import image as images
from torchtex.recipes import solid_run as recipe
from torchtex.recipes.solid_result import SolidStep
from torchtex.volumes.files import load_volume

LINE = ("solid", "z.png", "--size", "16x17x18", "--steps", "1", "--quiet")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with exemplars, which is the current one."""
    monkeypatch.chdir(tmp_path)
    images.save("z.png", stripes(32, 32).float())
    images.save("grey.png", stripes(32, 32, 1).float())
    images.save("small.png", torch.ones(3, 11, 11))
    images.save("map.png", stripes(32, 32, 1, seed=3).float())
    images.save("glass.png", torch.cat([stripes(32, 32), torch.zeros(1, 32, 32)]).float())
    return tmp_path


@pytest.mark.parametrize("name", ["v.npy", "v.nrrd", "v.vti", "slices"])
def test_volumes_are_written(run: Run, here: Path, name: str) -> None:
    done = run(*LINE, "-o", name, "--slices", "cut.png", "--report", "r.json")
    assert done.code == 0, done
    assert done.out.strip() == name
    volume = load_volume(name)
    assert volume.shape == (3, 16, 17, 18)
    about = json.loads(Path("r.json").read_text())
    assert about["command"] == "solid"
    assert about["settings"]["method"] == "kopf"
    assert set(about["files"]) == {"z.png"}
    assert "torchtex" in images.read_metadata("cut.png")
    again = run(*LINE, "-o", "again.npy", "--threads", 2)
    assert again.code == 0
    assert torch.equal(load_volume("again.npy"), volume)


@pytest.mark.parametrize("source", ["r.json", "cut.png"])
def test_a_solid_is_made_again_from_its_report_or_its_slices(
    run: Run, here: Path, source: str
) -> None:
    assert run(*LINE, "-o", "v.npy", "--slices", "cut.png", "--report", "r.json").code == 0
    done = run("repeat", source, "-o", "again.npy", "--quiet")
    assert done.code == 0, done
    assert Path("again.npy").read_bytes() == Path("v.npy").read_bytes()
    assert run("repeat", "r.json", "-o", "again.png", "--quiet").code == 2


def test_skeletal_axes_and_maps(run: Run, here: Path) -> None:
    line = ("solid", "z.png", "none", "grey.png", "--size", "16x16x16", "-o", "v.npy", "--quiet")
    assert run(*line, "--method", "skeletal", "--bits", 16).code == 0
    assert load_volume("v.npy").shape == (3, 16, 16, 16)
    mapped = run(*LINE, "-o", "m.npy", "--map", "map.png", "--map-weight", 2)
    assert mapped.code == 0, mapped
    assert run(*LINE, "-o", "plain.npy").code == 0
    assert not torch.equal(load_volume("m.npy"), load_volume("plain.npy"))


def test_masks_features_and_tiles(run: Run, here: Path) -> None:
    alpha = torch.ones(1, 32, 32)
    alpha[:, 20:] = 0
    images.save("part.png", torch.cat([stripes(32, 32).float(), alpha]))
    images.save("white.png", alpha)
    assert run(*LINE[:1], "part.png", *LINE[2:], "-o", "a.npy").code == 0
    assert run(*LINE, "--mask", "white.png", "-o", "b.npy").code == 0
    assert torch.equal(load_volume("a.npy"), load_volume("b.npy"))
    assert run(*LINE, "--feature", "haar", "--tiled", "20x34x18", "-o", "t.npy").code == 0
    tiles = load_volume("t.npy")
    assert tiles.shape == (3, 20, 34, 18)
    assert torch.equal(tiles[:, 16:, 17:], tiles[:, :4, :17])


def test_what_is_left_out_is_told(run: Run, here: Path) -> None:
    images.save("odd.png", stripes(33, 34).float())
    line = ("solid", "odd.png", "--size", "16x16x16", "--method", "skeletal", "-o", "v.npy")
    done = run(*line)
    assert done.code == 0
    assert "odd.png': the last 1 rows and 0 columns fill no coarse pixel" in done.err


def test_an_interrupted_run_keeps_what_it_has_and_goes_on(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = ("solid", "z.png", "--size", "32x32x32", "--steps", "1", "--quiet")
    assert run(*line, "-o", "whole.npy").code == 0
    usual = recipe.SolidStep

    def step(done: float, note: str, *rest: Any) -> SolidStep:
        if note.startswith("level 2"):
            signal.raise_signal(signal.SIGINT)
        return usual(done, note, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(recipe, "SolidStep", step)
        done = run(*line, "-o", "part.npy", "--checkpoint", "state.npz", "--keep-partial")
    assert done.code == 130
    assert load_volume("part.npy").shape == (3, 32, 32, 32)
    assert Path("state.npz").exists()
    wrong = run(*line, "-o", "rest.npy", "--checkpoint", "state.npz", "--seed", 5)
    assert wrong.code == 2
    assert "checkpoint='state.npz' is of a run with seed=0 and this one has seed=5" in wrong.err
    assert "give the same options, or delete it" in wrong.err
    assert run(*line, "-o", "rest.npy", "--checkpoint", "state.npz").code == 0
    assert torch.equal(load_volume("rest.npy"), load_volume("whole.npy"))
    assert not Path("state.npz").exists()


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("size='16x16'", ("z.png", "--size", "16x16", "-o", "v.npy")),
        ("size=4x16x16", ("z.png", "--size", "4x16x16", "-o", "v.npy")),
        ("GiB", ("z.png", "--size", "9999x9999x9999", "-o", "v.npy")),
        ("must end in", ("z.png", "--size", "16x16x16", "-o", "v.obj")),
        ("bits=12", ("z.png", "--size", "16x16x16", "-o", "v.npy", "--bits", "12")),
        ("method='fast'", ("z.png", "--size", "16x16x16", "-o", "v.npy", "--method", "fast")),
        ("no such file", ("no.png", "--size", "16x16x16", "-o", "v.npy")),
        ("4 given", (*["z.png"] * 4, "--size", "16x16x16", "-o", "v.npy")),
        ("none given", ("none", "--size", "16x16x16", "-o", "v.npy")),
        ("too little choice", ("small.png", "--size", "16x16x16", "-o", "v.npy")),
        ("transparent", ("glass.png", "--size", "16x16x16", "-o", "v.npy")),
        ("map: 2 given", ("z.png", "--size", "16x16x16", "-o", "v.npy", *["--map=map.png"] * 2)),
        ("size of the", ("z.png", "--size", "16x16x16", "-o", "v.npy", "--map", "small.png")),
        ("steps=2", ("z.png", "--size=16x16x16", "-o=v.npy", "--method=skeletal", "--steps=2")),
        ("octaves=2 belongs", ("z.png", "--size=16x16x16", "-o=v.npy", "--octaves=2")),
        ("refine=2 belongs", ("z.png", "--size=16x16x16", "-o=v.npy", "--refine=2")),
        ("octaves=5", ("z.png", "--size=16x16x16", "-o=v.npy", "--method=skeletal", "--octaves=5")),
        ("feature='sift'", ("z.png", "--size=16x16x16", "-o=v.npy", "--feature=sift")),
        ("tiled='9'", ("z.png", "--size=16x16x16", "-o=v.npy", "--tiled=9")),
        ("GiB", ("z.png", "--size=16x16x16", "-o=v.npy", "--tiled=9999x9999x9999")),
        ("mask: 2 given", ("z.png", "--size=16x16x16", "-o=v.npy", *["--mask=map.png"] * 2)),
        ("r=3", ("z.png", "--size", "16x16x16", "-o", "v.npy", "--r", "3")),
        ("seed=-1", ("z.png", "--size", "16x16x16", "-o", "v.npy", "--seed", "-1")),
        ("overwrite", ("z.png", "--size", "16x16x16", "-o", "v.npy", "--slices", "z.png")),
        (
            "checkpoint='bad.npz' is not a checkpoint of a solid; delete it",
            ("z.png", "--size=16x16x16", "-o=v.npy", "--checkpoint=bad.npz"),
        ),
        ("slice_0000.png is in it", ("slices/slice_0000.png", "--size=16x16x16", "-o", "slices")),
        ("slices is in it", ("z.png", "--size=16x16x16", "-o", "slices", "--slices=slices/s.png")),
        ("report is in it", ("z.png", "--size=16x16x16", "-o", "slices", "--report=slices/r.json")),
        (
            "checkpoint is in it",
            ("z.png", "--size=16x16x16", "-o", "slices", "--checkpoint=slices/c.npz"),
        ),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_input_gets_one_sentence(
    run: Run, here: Path, words: str, options: tuple[str, ...]
) -> None:
    Path("bad.npz").write_text("no checkpoint")
    Path("slices").mkdir()
    if options[0].startswith("slices"):
        Path("slices", "slice_0000.png").write_bytes(Path("z.png").read_bytes())
    refused(run, here, words, "solid", *options, "--quiet")
