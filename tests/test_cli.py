"""The command line: results, sentences for bad input, interrupts, what is imported."""

import json
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Done, Run, pixels, refused
from PIL import Image

import torchtex
from torchtex import cli, data
from torchtex import image as images
from torchtex.cli import base, synth
from torchtex.labels import LabelField

ROOT = Path(torchtex.__file__).parent.parent
SMALL = ("--size", "40x44", "--schedule", "0.5:8:1,1:8:2", "--quiet")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with pictures, which is the current one."""
    monkeypatch.chdir(tmp_path)
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(3, 10, 12, generator=generator)
    colour = images.resize(coarse, (40, 48)).clamp(0, 1)
    grey = images.luminance(colour)[None]
    images.save("z.png", colour)
    images.save("grey.png", grey)
    images.save("deep.png", grey, bits=16)
    images.save("deeprgb.png", colour, bits=16)
    images.save("target.png", torch.full((3, 40, 44), 0.8))
    images.save("pixel.png", colour[:, :1, :1])
    images.save("tiny.png", colour[:, :7, :7])
    left = torch.zeros(1, 40, 48)
    images.save("empty.png", left)
    left[..., :24] = 1
    images.save("left.png", left)
    images.save("half.png", left[..., :44])
    images.save("alpha.png", torch.cat([colour, 1 - left]))
    whole = Image.open("z.png")
    whole.convert("CMYK").save("cmyk.jpg")
    whole.convert("P").save("palette.png")
    exif = Image.Exif()
    exif[274] = 6  # turned by 90 degrees
    whole.save("turned.jpg", exif=exif)
    for name, value in (("nan", np.nan), ("inf", np.inf)):
        values = np.full((40, 48), 0.5, np.float32)
        values[3, 4] = value
        Image.fromarray(values).save(f"{name}.tif")
    values = np.linspace(0, 2, 40 * 48, dtype=np.float32).reshape(40, 48)
    Image.fromarray(values).save("height.tif")
    Path("cut.png").write_bytes(Path("z.png").read_bytes()[:900])
    Path("text.png").write_text("no picture")
    Path("text.npz").write_text("no labels")
    Path("folder").mkdir()
    return tmp_path


# ------------------------------------------------------------------------------- results


def test_synth_writes_a_texture_of_the_size_and_prints_where(run: Run, here: Path) -> None:
    done = run("synth", "z.png", "-o", "x.png", *SMALL)
    assert done == Done(0, "x.png\n", "")
    assert pixels("x.png").shape == (3, 40, 44)


def test_a_bundled_name_is_an_exemplar(run: Run, here: Path) -> None:
    assert run("synth", "gravel", "-o", "x.png", *SMALL).code == 0
    assert pixels("x.png").shape == (1, 40, 44)


@pytest.mark.parametrize("suffix", [".jpg", ".tif"])
def test_other_formats_hold_the_options_too(run: Run, here: Path, suffix: str) -> None:
    assert run("synth", "z.png", "-o", f"x{suffix}", *SMALL).code == 0
    assert pixels(f"x{suffix}").shape == (3, 40, 44)
    assert run("repeat", f"x{suffix}", "-o", "y.png", "--quiet").code == 0
    assert run("repeat", "y.png", "-o", "again.png", "--quiet").code == 0
    assert torch.equal(pixels("y.png"), pixels("again.png"))


@pytest.mark.parametrize(
    "options",
    [
        ("--feature", "gradients"),
        ("--feature", "haar"),
        ("--feature", "db2", "--r", "2"),
        ("--start", "neighborhoods", "--completeness", "0"),
        ("--boundary", "periodic"),
        ("--match", "exact"),
        ("--mask", "left.png"),
        ("--init", "grey.png"),
        ("--target", "target.png", "--confidence", "100"),
        ("--bits", "16"),
        ("--steps", "1"),
        ("--device", "cpu"),
    ],
    ids=" ".join,
)
def test_repeat_gives_the_same_bits_whatever_the_options(
    run: Run, here: Path, options: tuple[str, ...]
) -> None:
    assert run("synth", "z.png", "-o", "x.png", *SMALL, "--seed", "3", *options).code == 0
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))


def test_threads_change_no_bit_and_seeds_do(run: Run, here: Path) -> None:
    for threads in (1, 2):
        done = run("synth", "z.png", "-o", f"{threads}.png", *SMALL, "--threads", threads)
        assert done.code == 0
        assert torch.get_num_threads() == threads
    assert torch.equal(pixels("1.png"), pixels("2.png"))
    assert run("synth", "z.png", "-o", "3.png", *SMALL, "--seed", "1").code == 0
    assert not torch.equal(pixels("1.png"), pixels("3.png"))


def test_several_exemplars_and_grey_becomes_rgb(run: Run, here: Path) -> None:
    done = run(
        "synth", "z.png", "grey.png", "-o", "x.png", *SMALL, "--mask", "left.png", "--mask", "z.png"
    )
    assert done.code == 0
    assert pixels("x.png").shape[0] == 3


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("cmyk.jpg", (3, 40, 48)),
        ("palette.png", (3, 40, 48)),
        ("deep.png", (1, 40, 48)),
        ("deeprgb.png", (3, 40, 48)),
        ("alpha.png", (3, 40, 48)),
        ("turned.jpg", (3, 48, 40)),
    ],
)
def test_all_kinds_of_pictures_are_exemplars(
    run: Run, here: Path, name: str, shape: tuple[int, ...]
) -> None:
    done = run("synth", name, "-o", "x.png", *SMALL, "--labels", "x.npz")
    assert done.code == 0, done.err
    assert pixels("x.png").shape[0] == shape[0]
    assert LabelField.load("x.npz").shapes == (shape[1:],)
    with Image.open("x.png") as picture:
        assert picture.mode in ("L", "RGB")


def test_alpha_and_mask_are_both_kept_to(run: Run, here: Path) -> None:
    top = torch.zeros(1, 40, 48)
    top[:, :20] = 1
    images.save("top.png", top)
    done = run(
        "synth", "alpha.png", "--mask", "top.png", "-o", "x.png", *SMALL, "--labels", "x.npz"
    )
    assert done.code == 0
    source = LabelField.load("x.npz").source_map()
    assert source[..., 1].max() < 20
    assert source[..., 2].min() >= 24


def test_a_target_pulls_where_its_mask_is_white(run: Run, here: Path) -> None:
    mask = torch.zeros(1, 40, 44)
    mask[..., :22] = 1
    images.save("tm.png", mask)
    target = ("--target", "target.png", "--target-mask", "tm.png", "--confidence", "10000")
    assert run("synth", "z.png", "-o", "x.png", *SMALL, *target).code == 0
    off = (pixels("x.png") - 0.8).abs().mean((0, 1))
    assert off[:20].max() < 0.02
    assert off[26:].mean() > 0.05


def test_labels_render_a_16_bit_map_as_16_bits(run: Run, here: Path) -> None:
    assert run("synth", "z.png", "-o", "x.png", *SMALL, "--labels", "l.npz").code == 0
    assert run("apply", "l.npz", "deep.png", "-o", "y.png") == Done(0, "y.png\n", "")
    with Image.open("y.png") as picture:
        assert picture.mode.startswith("I")
    wanted = LabelField.load("l.npz").apply(pixels("deep.png"))
    assert torch.allclose(pixels("y.png"), wanted, atol=1e-4)
    assert run("apply", "l.npz", "z.png", "-o", "same.png").code == 0
    assert torch.equal(pixels("same.png"), pixels("x.png"))
    assert run("apply", "l.npz", "deeprgb.png", "-o", "y.jpg").code == 0
    assert run("apply", "l.npz", "deep.png", "-o", "y8.png", "--bits", "8").code == 0
    with Image.open("y8.png") as picture:
        assert picture.mode == "L"


def test_report_and_metadata_hold_version_and_options(run: Run, here: Path) -> None:
    assert run("synth", "z.png", "-o", "x.png", *SMALL, "--report", "r.json").code == 0
    report = json.loads(Path("r.json").read_text())
    assert report == json.loads(images.read_metadata("x.png")["torchtex"])
    assert report["version"] == torchtex.__version__
    assert report["options"]["exemplar"] == ["z.png"]
    assert report["options"]["schedule"] == "0.5:8:1,1:8:2"
    assert [len(level["energies"]) for level in report["levels"]] == [2, 4]


def test_bits(run: Run, here: Path) -> None:
    assert run("synth", "deep.png", "-o", "8.png", *SMALL).code == 0
    assert run("synth", "deep.png", "-o", "16.png", *SMALL, "--bits", "16").code == 0
    modes = []
    for name in ("8.png", "16.png"):
        with Image.open(name) as picture:
            modes.append(picture.mode)
    assert modes[0] == "L"
    assert modes[1].startswith("I")


def test_metrics(run: Run, here: Path) -> None:
    done = run("metrics", "z.png", "--exemplar", "z.png", "--json", "--tileable")
    values = json.loads(done.out)
    assert values["nn"] < 1e-6
    assert values["copy"] == 1
    assert "seam" in values
    assert "swd" in run("metrics", "grey.png", "--exemplar", "z.png").out


def test_info(run: Run) -> None:
    values = json.loads(run("info", "--json").out)
    assert {"pymaxflow", "ortools"} <= set(values["min-cut"])
    assert values["versions"]["torchtex"] == torchtex.__version__
    assert values["devices"][0] == "cpu"
    assert values["exemplars"] == list(data.names())
    assert f"torch {version('torch')}" in run("info").out  # a local +cpu may be left out


@pytest.mark.parametrize("arguments", [("--help",), (), ("synth", "--help"), ("repeat", "--help")])
def test_help(run: Run, arguments: tuple[str, ...]) -> None:
    done = run(*arguments)
    assert done.code == 0
    assert "Usage: torchtex" in done.out


def test_version(run: Run) -> None:
    assert run("--version") == Done(0, f"{torchtex.__version__}\n", "")


# ------------------------------------------------------------------------------ progress


def test_one_line_per_level_where_there_is_no_terminal(run: Run, here: Path) -> None:
    done = run("synth", "z.png", "-o", "x.png", *SMALL[:-1])
    assert done.err.splitlines() == [
        "level 1 of 2: scale 0.5, window 8",
        "level 2 of 2: scale 1, window 8",
    ]


def test_a_bar_on_a_terminal(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    done = run("synth", "z.png", "-o", "x.png", *SMALL[:-1])
    assert done.code == 0
    assert "level 2 of 2: scale 1, window 8" in done.err
    assert "energy" in done.err


# ------------------------------------------------------------------------------ bad input

X = ("-o", "x.png", "--size", "40x44")
BAD: list[tuple[str, tuple[str, ...]]] = [
    ("exemplar of 7x7", ("synth", "tiny.png", *X)),
    ("exemplar of 1x1", ("synth", "pixel.png", *X)),
    ("exemplar of 40x48 for size=3x3", ("synth", "z.png", "-o", "x.png", "--size", "3x3")),
    ("mask='empty.png' is empty", ("synth", "z.png", *X, "--mask", "empty.png")),
    ("mask='half.png' has 40 x 44", ("synth", "z.png", *X, "--mask", "half.png")),
    ("mask='left.png' is white only", ("synth", "alpha.png", *X, "--mask", "left.png")),
    ("mask: 1 given for 2", ("synth", "z.png", "grey.png", *X, "--mask", "left.png")),
    ("mask='none.png': there is no such file", ("synth", "z.png", *X, "--mask", "none.png")),
    ("exemplar='nan.tif' holds NaN", ("synth", "nan.tif", *X)),
    ("exemplar='inf.tif' holds NaN or infinity", ("synth", "inf.tif", *X)),
    ("exemplar='cut.png' is damaged", ("synth", "cut.png", *X)),
    ("exemplar='text.png' is none of", ("synth", "text.png", *X)),
    ("exemplar='folder' is a folder", ("synth", "folder", *X)),
    ("exemplar='none.png': there is no such file", ("synth", "none.png", *X)),
    ("exemplar='gravle' is no file and no bundled", ("synth", "gravle", *X)),
    ("size='0x44'", ("synth", "z.png", "-o", "x.png", "--size", "0x44")),
    ("size='-5x44'", ("synth", "z.png", "-o", "x.png", "--size", "-5x44")),
    ("size='wide'", ("synth", "z.png", "-o", "x.png", "--size", "wide")),
    (
        "size=1000000x1000000 would need about",
        ("synth", "z.png", "-o", "x.png", "--size", "1000000x1000000"),
    ),
    ("feature='db22' is unknown; did you mean db2", ("synth", "z.png", *X, "--feature", "db22")),
    ("feature='sift' is unknown; choose pixels", ("synth", "z.png", *X, "--feature", "sift")),
    ("start='block' is unknown; did you mean blocks", ("synth", "z.png", *X, "--start", "block")),
    ("boundary='open' is unknown", ("synth", "z.png", *X, "--boundary", "open")),
    ("match='near' is unknown", ("synth", "z.png", *X, "--match", "near")),
    ("output='no/x.png': there is no folder", ("synth", "z.png", *X, "-o", "no/x.png")),
    ("output='folder.png' is no ordinary file", ("synth", "z.png", *X, "-o", "folder.png")),
    ("output='x.psd' must end in", ("synth", "z.png", *X, "-o", "x.psd")),
    ("output='z.png' would overwrite an input", ("synth", "z.png", *X, "-o", "z.png")),
    ("labels='l.txt' must end in .npz", ("synth", "z.png", *X, "--labels", "l.txt")),
    ("report='no/r.json': there is no folder", ("synth", "z.png", *X, "--report", "no/r.json")),
    ("device='warp' is unknown", ("synth", "z.png", *X, "--device", "warp")),
    ("device='cuda:999' is not available", ("synth", "z.png", *X, "--device", "cuda:999")),
    ("r=0.0 must lie in (0, 2]", ("synth", "z.png", *X, "--r", "0")),
    ("r=2.5 must lie in (0, 2]", ("synth", "z.png", *X, "--r", "2.5")),
    ("r=nan must lie in (0, 2]", ("synth", "z.png", *X, "--r", "nan")),
    ("completeness=-1.0", ("synth", "z.png", *X, "--completeness", "-1")),
    ("schedule='1:8': '1:8' is not scale", ("synth", "z.png", *X, "--schedule", "1:8")),
    ("schedule='2:8:1': scale=2.0", ("synth", "z.png", *X, "--schedule", "2:8:1")),
    ("schedule='1:8:1,': ''", ("synth", "z.png", *X, "--schedule", "1:8:1,")),
    ("schedule='nan:8:1'", ("synth", "z.png", *X, "--schedule", "nan:8:1")),
    ("steps=0", ("synth", "z.png", *X, "--steps", "0")),
    ("--steps", ("synth", "z.png", *X, "--steps", "many")),
    ("--threads", ("synth", "z.png", *X, "--threads", "0")),
    ("seed=-1", ("synth", "z.png", *X, "--seed", "-1")),
    ("checkpoint=text.npz is not a checkpoint", ("synth", "z.png", *X, "--checkpoint", "text.npz")),
    ("checkpoint='c.txt' must end in .npz", ("synth", "z.png", *X, "--checkpoint", "c.txt")),
    ("bits=12 must be 8 or 16", ("synth", "z.png", *X, "--bits", "12")),
    ("bits=16", ("synth", "z.png", *X, "-o", "x.jpg", "--bits", "16")),
    ("init='target.png' is in colour", ("synth", "grey.png", *X, "--init", "target.png")),
    ("target='z.png' has 40x48", ("synth", "z.png", *X, "--target", "z.png")),
    ("target-mask='left.png' needs", ("synth", "z.png", *X, "--target-mask", "left.png")),
    (
        "target-mask='left.png' has 40 x 48",
        ("synth", "z.png", *X, "--target", "target.png", "--target-mask", "left.png"),
    ),
    (
        "confidence=-1.0",
        ("synth", "z.png", *X, "--target", "target.png", "--confidence", "-1"),
    ),
    ("--size", ("synth", "z.png", "-o", "x.png")),
    ("exemplar", ("synth", *X)),
    ("--colour", ("synth", "z.png", *X, "--colour")),
    ("paint", ("paint", "z.png")),
    ("labels=text.npz is not a label file", ("apply", "text.npz", "z.png", "-o", "x.png")),
    ("labels=none.npz", ("apply", "none.npz", "z.png", "-o", "x.png")),
    ("map is 40x44", ("apply", "good.npz", "target.png", "-o", "x.png")),
    ("map: 2 given for 1", ("apply", "good.npz", "z.png", "z.png", "-o", "x.png")),
    ("map='height.tif' has values from 0 to 2", ("apply", "good.npz", "height.tif", "-o", "x.png")),
    ("bits=16", ("apply", "good.npz", "z.png", "-o", "x.jpg", "--bits", "16")),
    ("result='z.png' does not say how", ("repeat", "z.png", "-o", "x.png")),
    ("result='odd.png' holds metadata", ("repeat", "odd.png", "-o", "x.png")),
    ("result='list.png' holds metadata", ("repeat", "list.png", "-o", "x.png")),
    ("result='types.png' holds options", ("repeat", "types.png", "-o", "x.png")),
    ("result='applied.png' was made by torchtex apply", ("repeat", "applied.png", "-o", "x.png")),
    ("result='none.png': there is no such file", ("repeat", "none.png", "-o", "x.png")),
    ("exemplar='none.png'", ("metrics", "z.png", "--exemplar", "none.png")),
    ("texture='none.png'", ("metrics", "none.png", "--exemplar", "z.png")),
]


@pytest.mark.parametrize(("words", "arguments"), BAD, ids=[words for words, _ in BAD])
def test_bad_input_gets_one_sentence_and_code_2(
    run: Run, here: Path, words: str, arguments: tuple[str, ...]
) -> None:
    Path("folder.png").mkdir()
    field = LabelField(
        torchtex.Grid(8, 8, 8, 8), torch.tensor([[0, 2, 1]]), torch.ones(1), ((40, 48),)
    )
    field.save("good.npz")
    grey = torch.zeros(1, 4, 4)
    options = {"exemplar": ["z.png"], "size": 7}
    for name, text in (
        ("odd", "no json"),
        ("list", "[1]"),
        ("types", json.dumps({"options": options, "files": {}})),
        ("applied", json.dumps({"command": "apply", "options": {}})),
    ):
        images.save(f"{name}.png", grey, metadata={"torchtex": text})
    refused(run, here, words, *arguments)


def test_a_folder_that_is_not_writable(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    done = run("synth", "z.png", *X, "-o", "folder/x.png")
    assert done.code == 2
    assert "output='folder/x.png': the folder is not writable" in done.err


def test_repeat_refuses_files_that_changed_or_are_gone(run: Run, here: Path) -> None:
    assert run("synth", "z.png", "-o", "x.png", *SMALL, "--mask", "left.png").code == 0
    images.save("left.png", torch.ones(1, 40, 48))
    done = run("repeat", "x.png", "-o", "y.png")
    assert done.code == 2
    assert "'left.png', which has changed" in done.err
    Path("z.png").unlink()
    done = run("repeat", "x.png", "-o", "y.png")
    assert done.code == 2
    assert "'z.png', which is missing" in done.err
    assert not Path("y.png").exists()


def test_no_memory_is_a_sentence(run: Run, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def load(*_: Any) -> None:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9")

    monkeypatch.setattr(synth, "_load", load)
    done = run("synth", "z.png", *X)
    assert done.code == 2
    assert "not enough memory" in done.err


def test_our_own_mistakes_are_not_hidden(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def load(*_: Any) -> None:
        raise AssertionError("ours")

    monkeypatch.setattr(synth, "_load", load)
    with pytest.raises(AssertionError, match="ours"):
        cli.main(["synth", "z.png", *X])


# ------------------------------------------------------------------- imports and interrupts


def python(*arguments: str, cwd: Path) -> "subprocess.Popen[str]":
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        ("import torchtex.cli", "torch numpy faiss kornia pywt PIL matplotlib gradio"),
        ("import torchtex; torchtex.synthesize", "faiss matplotlib gradio"),
    ],
)
def test_what_is_not_imported(tmp_path: Path, code: str, absent: str) -> None:
    code += "; import sys; print(*sys.modules)"
    process = python("-c", code, cwd=tmp_path)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert not set(absent.split()) & set(out.split())


@pytest.mark.skipif(os.name != "posix", reason="signals differ")
@pytest.mark.parametrize("keep", [False, True])
def test_ctrl_c_in_a_level(tmp_path: Path, keep: bool) -> None:
    options = ["--size", "256x240", "--schedule", "0.5:8:400,1:8:400", "--match", "exact"]
    process = python(
        *("-m", "torchtex", "synth", "gravel", "-o", "x.png", "--threads", "1"),
        *(*options, *(["--keep-partial"] if keep else [])),
        cwd=tmp_path,
    )
    assert process.stderr is not None
    try:
        first = process.stderr.readline()
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert first.startswith("level 1 of 2")
    assert process.returncode == 130, err
    assert err.splitlines()[-1] == "torchtex: interrupted"
    assert "Traceback" not in err
    if not keep:
        assert list(tmp_path.iterdir()) == []
        return
    assert out == "x.png\n"
    assert [path.name for path in tmp_path.iterdir()] == ["x.png"]
    picture = images.load(tmp_path / "x.png").image
    assert picture.shape == (1, 256, 240)
    assert picture.std() > 0.02
    assert json.loads(images.read_metadata(tmp_path / "x.png")["torchtex"])["partial"] is True


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("swallowed")])
def test_an_interrupt_before_any_pixel_writes_nothing(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def load(*_: Any) -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise error from None

    monkeypatch.setattr(synth, "_load", load)
    before = signal.getsignal(signal.SIGINT)
    done = run("synth", "z.png", *X, "--keep-partial")
    assert done.code == 130
    assert done.err.strip() == "torchtex: interrupted"
    assert signal.getsignal(signal.SIGINT) is before
    assert not Path("x.png").exists()


def test_an_interrupted_run_goes_on_from_its_checkpoint(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("synth", "z.png", *SMALL, "--seed", "2")
    assert run(*command, "-o", "whole.png").code == 0
    seen: list[int] = []

    class Watch(base.Watch):
        def __call__(self, progress: Any) -> None:
            super().__call__(progress)
            seen.append(progress.level)
            if progress.level == 1 and len(seen) < 5:
                signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(base, "Watch", Watch)
    again = (*command, "-o", "x.png", "--checkpoint", "c.npz")
    assert run(*again).code == 130
    assert Path("c.npz").exists()
    assert not Path("x.png").exists()
    seen[:] = [0] * 9
    assert run(*again).code == 0
    assert set(seen[9:]) == {1}
    assert not Path("c.npz").exists()
    both = [images.load(name).image for name in ("whole.png", "x.png")]
    assert torch.equal(*both)
    seen[:] = []
    assert run(*again).code == 130
    done = run(*again, "--r", "1")
    assert done.code == 2
    assert "resume: the checkpoint is of a run with r=0.8" in done.err
