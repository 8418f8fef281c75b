"""The command animate: what it writes, interrupts and going on, sentences for bad input."""

import inspect
import json
import os
import signal
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Run, pixels, refused, stripes

from torchtex import image as images
from torchtex.cli.moving import animate
from torchtex.recipes import montage
from torchtex.recipes.animate import Motion

LINE = ("animate", "z.png", "--size", "32x36", "--flow", "source:1", "--quiet")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an exemplar and flows, which is the current one."""
    monkeypatch.chdir(tmp_path)
    images.save("z.png", stripes(32, 32).float())
    images.save("white.png", torch.ones(1, 32, 32))
    np.save("small.npy", np.zeros((2, 8, 8), np.float32))
    np.save("two.npy", np.zeros((2, 2, 32, 36), np.float32))
    np.save("nan.npy", np.full((2, 32, 36), np.nan, np.float32))
    return tmp_path


def interrupt_at(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Ctrl-C as soon as that frame is there."""
    usual = montage.Stage

    def stage(done: float, note: str, texture: Any, detail: str) -> Any:
        if detail.startswith(f"{number + 1} of"):
            signal.raise_signal(signal.SIGINT)
        return usual(done, note, texture, detail)

    monkeypatch.setattr(montage, "Stage", stage)


def frame_bytes(folder: str) -> list[bytes]:
    """Frames of a folder in order."""
    return [path.read_bytes() for path in sorted(Path(folder).glob("frame_*.png"))]


@pytest.mark.parametrize("name", ["x.gif", "x.webp", "x.apng", "x.mp4"])
def test_films_are_written(run: Run, here: Path, name: str) -> None:
    if name.endswith(".mp4"):
        pytest.importorskip("imageio_ffmpeg", reason="imageio_ffmpeg is not installed")
    done = run(*LINE, "--frames", 3, "-o", name)
    assert done.code == 0, done
    assert done.out.strip() == name
    assert os.path.getsize(name) > 500


def test_a_folder_a_report_and_a_picture_of_the_flow(run: Run, here: Path) -> None:
    line = (*LINE, "--frames", 3, "--report", "r.json", "--flow-picture", "flow.png")
    assert run(*line, "-o", "frames").code == 0
    assert len(frame_bytes("frames")) == 3
    assert len(list(Path("frames").iterdir())) == 4  # and the state
    report = json.loads(Path("r.json").read_text())
    assert [line["frame"] for line in report["frames"]] == [0, 1, 2]
    assert report["frames"][1]["warp_error"] > 0
    assert report["options"]["flow"] == "source:1"
    assert pixels("flow.png").shape == (3, 32, 36)


def test_a_comparison_is_three_frames_wide(run: Run, here: Path) -> None:
    from PIL import Image

    assert run(*LINE, "--frames", 3, "--compare", "--keep", "kept", "-o", "x.gif").code == 0
    with Image.open("x.gif") as film:
        assert film.size == (3 * 36, 32)
    assert pixels("kept/frame_00001.png").shape == (3, 32, 36)


def test_an_interrupted_folder_goes_on(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(*LINE, "--frames", 5, "-o", "whole").code == 0
    with monkeypatch.context() as patch:
        interrupt_at(patch, 3)
        done = run(*LINE, "--frames", 5, "-o", "parts")
    assert done.code == 130
    assert len(frame_bytes("parts")) == 3
    refused(run, here / "parts", "other options", *LINE, "--frames", 5, "--hold", 2, "-o", "parts")
    assert run(*LINE, "--frames", 5, "-o", "parts", "--report", "r.json").code == 0
    assert frame_bytes("parts") == frame_bytes("whole")
    lines = json.loads(Path("r.json").read_text())["frames"]
    assert [line["frame"] for line in lines] == [0, 1, 2, 3, 4]


def test_a_finished_folder_goes_on_or_refuses(run: Run, here: Path) -> None:
    assert run(*LINE, "--frames", 5, "-o", "whole").code == 0
    assert run(*LINE, "--frames", 2, "-o", "parts").code == 0
    for words, options in (
        ("output='parts' holds frames of other options", ("--frames", 2, "--seed", 5)),
        ("holds 2 frames and 1 are wanted", ("--frames", 1)),
        ("holds 2 frames and 1 are wanted", ("--frames", 5, "--preview", 1)),
    ):
        refused(run, here / "parts", words, *LINE, *options, "-o", "parts")
    before = frame_bytes("parts")
    assert run(*LINE, "--frames", 2, "-o", "parts", "--report", "r.json").code == 0
    assert frame_bytes("parts") == before
    assert len(json.loads(Path("r.json").read_text())["frames"]) == 2
    assert run(*LINE, "--frames", 5, "-o", "parts").code == 0
    assert torch.equal(pixels("parts/frame_00004.png"), pixels("whole/frame_00004.png"))
    assert len(frame_bytes("parts")) == 5
    assert run("repeat", "parts", "-o", "again", "--quiet").code == 0
    assert frame_bytes("again") == frame_bytes("whole")


@pytest.mark.parametrize(
    ("output", "name"), [(("-o", "kept"), "output"), (("-o", "x.gif", "--keep", "kept"), "keep")]
)
def test_a_folder_that_is_not_whole(
    run: Run, here: Path, output: tuple[str, ...], name: str
) -> None:
    line = (*LINE, "--frames", 3, *output)
    assert run(*line).code == 0
    kept, frame = Path("kept"), Path("kept/frame_00001.png")
    whole = frame.read_bytes()
    for path, data, words in (
        (frame, whole[:100], "frame 1 is damaged; empty the folder to start again"),
        (frame, None, "frame 1 is missing; empty the folder to start again"),
        (kept / "state.npz", b"PK", "its state.npz is damaged; empty the folder"),
        (kept / "state.npz", None, "holds frame 2 without the state"),
    ):
        usual = path.read_bytes()
        path.unlink() if data is None else path.write_bytes(data)
        refused(run, kept, f"{name}='kept'", *line)
        refused(run, kept, words, *line)
        path.write_bytes(usual)
    (kept / "frame_00004.png").write_bytes(whole)
    refused(run, kept, "holds frame 4 without the state", *line)


def test_a_frame_beyond_the_state_is_made_again(run: Run, here: Path) -> None:
    """As an interrupt leaves it that comes between a frame and its state."""
    assert run(*LINE, "--frames", 3, "-o", "whole").code == 0
    assert run(*LINE, "--frames", 3, "--preview", 2, "-o", "parts").code == 0
    Path("parts/frame_00002.png").write_bytes(b"")
    assert run(*LINE, "--frames", 3, "-o", "parts").code == 0
    assert frame_bytes("parts") == frame_bytes("whole")


def test_a_film_of_the_first_of_the_kept_frames(run: Run, here: Path) -> None:
    line = (*LINE, "--keep", "kept", "--report", "r.json")
    assert run(*line, "--frames", 2, "-o", "two.gif").code == 0
    assert run(*line, "--frames", 4, "-o", "four.gif").code == 0
    assert run(*line, "--frames", 2, "-o", "again.gif").code == 0
    assert Path("again.gif").read_bytes() == Path("two.gif").read_bytes()
    assert len(json.loads(Path("r.json").read_text())["frames"]) == 2
    assert len(frame_bytes("kept")) == 4


def test_an_interrupted_film_goes_on_from_what_was_kept(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = (*LINE, "--frames", 4)
    assert run(*line, "-o", "whole.gif").code == 0
    with monkeypatch.context() as patch:
        interrupt_at(patch, 2)
        assert run(*line, "-o", "parts.gif", "--keep", "kept").code == 130
    assert not Path("parts.gif").exists()
    assert run(*line, "-o", "parts.gif", "--keep", "kept").code == 0
    assert Path("parts.gif").read_bytes() == Path("whole.gif").read_bytes()


@pytest.mark.parametrize("keep", [False, True])
def test_ctrl_c(run: Run, here: Path, monkeypatch: pytest.MonkeyPatch, keep: bool) -> None:
    before = set(here.iterdir())
    interrupt_at(monkeypatch, 2)
    done = run(*LINE, "--frames", 6, "-o", "x.gif", *(["--keep-partial"] if keep else []))
    assert done.code == 130
    assert done.err.strip() == "torchtex: interrupted"
    assert done.out.strip() == ("x.gif" if keep else "")
    assert {path.name for path in set(here.iterdir()) - before} == ({"x.gif"} if keep else set())


def test_threads_do_not_change_a_bit(run: Run, here: Path) -> None:
    for threads in (1, 2):
        line = (*LINE, "--frames", 3, "--threads", threads, "-o", f"frames{threads}")
        assert run(*line).code == 0
    assert frame_bytes("frames1") == frame_bytes("frames2")


def test_frames_that_tile_and_loop(run: Run, here: Path) -> None:
    line = (
        "animate",
        "z.png",
        "--size",
        "32x32",
        "--flow",
        "uniform:0,1",
        "--boundary",
        "periodic",
    )
    assert run(*line, "--frames", 4, "--loop", 2, "-o", "frames", "--quiet").code == 0
    assert len(frame_bytes("frames")) == 4


def test_a_note_on_flows_that_are_no_tiles(run: Run, here: Path) -> None:
    line = [word for word in LINE if word != "--quiet"] + ["--frames", "1", "-o", "x.gif"]
    note = "note: flow='source:1' is no tile, so motion jumps where tiles meet; write source:1,per"
    assert run(*line, "--boundary", "periodic").err.startswith(note)
    for options in ((), ("--boundary", "periodic", "--flow", "source:1,periodic")):
        assert "note" not in run(*line, *options).err


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("frames=0", "--frames 0"),
        ("frames=-2", "--frames=-2"),
        ("loop=4", "--loop 4"),
        ("loop=-1", "--loop=-1"),
        ("boundary='round'", "--boundary round"),
        ("patch=1", "--patch 1"),
        ("hold=-3", "--hold=-3"),
        ("follow=nan", "--follow nan"),
        ("repeat=-1", "--repeat=-1"),
        ("mend=-1", "--mend=-1"),
        ("fade=-1", "--fade=-1"),
        ("steps=0", "--steps 0"),
        ("solver", "--solver none"),
        ("rate=0", "--rate 0"),
        ("rate=60.0 is more than the 50", "--rate 60 -o x.gif"),
        ("seed=-1", "--seed=-1"),
        ("size='4'", "--size 4"),
        ("names no flow", "--flow vortx"),
        ("more than the width", "--flow uniform:0,50"),
        ("do not fit", "--flow small.npy"),
        ("2 flow fields", "--flow two.npy"),
        ("NaN", "--flow nan.npy"),
        ("no such file", "--flow missing.npy"),
        ("more than the", "--flow-scale 100"),
        ("factor=nan", "--flow-scale nan"),
        ("x.avi", "-o x.avi"),
        ("nowhere", "-o nowhere/x.gif"),
        ("z.png", "-o z.png"),
        ("keep='z.png' is a file", "--keep z.png"),
        ("nowhere", "--keep nowhere/kept"),
        ("report='r.txt'", "--report r.txt"),
        ("flow-picture='f.gif'", "--flow-picture f.gif"),
        ("flow-picture='z.png'", "--flow-picture z.png"),
        ("mask", "--mask white.png --mask white.png"),
        ("compare", "--compare -o frames"),
    ],
)
@pytest.mark.parametrize("output", ["bad.gif", "bad"])
def test_bad_input(run: Run, here: Path, words: str, options: str, output: str) -> None:
    usual = {"-o": output, "--size": "32x36", "--flow": "source:1", "--frames": "4"}
    given = options.split()
    line = [item for key, value in usual.items() if key not in given for item in (key, value)]
    refused(run, here, words, "animate", "z.png", *line, *given, "--quiet")


def test_without_the_encoder(run: Run, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    refused(run, here, "imageio-ffmpeg", *LINE, "--frames", 2, "-o", "x.mp4")


def test_a_folder_and_a_report_say_how_to_repeat_it(run: Run, here: Path) -> None:
    line = (*LINE, "--frames", 3, "--patch", 16)
    assert run(*line, "-o", "frames").code == 0
    assert run(*line, "-o", "film.gif", "--rate", 10, "--report", "r.json").code == 0
    assert run("repeat", "frames", "-o", "again", "--quiet").code == 0
    assert frame_bytes("again") == frame_bytes("frames")
    assert run("repeat", "r.json", "-o", "again.gif", "--quiet").code == 0
    assert Path("again.gif").read_bytes() == Path("film.gif").read_bytes()


def test_what_cannot_be_repeated(run: Run, here: Path) -> None:
    Path("empty").mkdir()
    Path("other.json").write_text("[1, 2]")
    Path("text.json").write_bytes(b"\xff\xfe")
    for name, words in (
        ("empty", "frame_00000.png"),
        ("other.json", "not complete"),
        ("text.json", "cannot be read"),
        ("missing.json", "no such file"),
    ):
        refused(run, here, words, "repeat", name, "-o", "x.gif")


def test_a_preview_is_gone_on_from(run: Run, here: Path) -> None:
    line = (*LINE, "--frames", 4)
    assert run(*line, "-o", "whole").code == 0
    assert run(*line, "--preview", 2, "-o", "parts").code == 0
    assert frame_bytes("parts") == frame_bytes("whole")[:2]
    assert run(*line, "-o", "parts").code == 0
    assert frame_bytes("parts") == frame_bytes("whole")
    refused(run, here, "preview=0", *line, "--preview", 0, "-o", "x.gif")


def test_a_motion_is_by_default_that_of_the_recipe() -> None:
    given = {name: option.default for name, option in inspect.signature(animate).parameters.items()}
    assert {field.name: given[field.name] for field in fields(Motion)} == vars(Motion())
