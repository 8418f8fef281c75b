"""The commands quilt and patchwise: what they write, repeat, sentences for bad input."""

import json
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Done, Run, pixels, refused

from torchtex import image as images
from torchtex.recipes import quilting
from torchtex.recipes.montage import Stage
from torchtex.sources import SourceField

OUT = ("-o", "x.png", "--quiet")
SIZE = (*OUT, "--size", "40x44")
COMMANDS = ("quilt", "patchwise")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with pictures, which is the current one."""
    monkeypatch.chdir(tmp_path)
    generator = torch.Generator().manual_seed(0)
    colour = images.resize(torch.rand(3, 8, 9, generator=generator), (26, 30)).clamp(0, 1)
    images.save("z.png", colour)
    images.save("grey.png", images.luminance(colour)[None])
    images.save("target.png", images.resize(colour, (33, 21)).clamp(0, 1))
    half = torch.zeros(1, 26, 30)
    images.save("empty.png", half)
    half[..., :20] = 1
    images.save("left.png", half)
    images.save("small.png", half[:, :20])
    images.save("alpha.png", torch.cat([colour, 1 - half]))
    images.save("pixel.png", colour[:, :1, :1])
    Path("text.png").write_text("no picture")
    return tmp_path


@pytest.mark.parametrize("command", COMMANDS)
def test_all_that_it_writes(run: Run, here: Path, command: str) -> None:
    done = run(
        command, "z.png", *SIZE, "--labels", "l.npz", "--report", "r.json", "--seams", "s.png",
        "--patch-map", "p.png",
    )  # fmt: skip
    assert done == Done(0, "x.png\n", "")
    assert pixels("x.png").shape == pixels("s.png").shape == pixels("p.png").shape == (3, 40, 44)
    report = json.loads(Path("r.json").read_text())
    assert report["command"] == report["settings"]["recipe"] == command
    assert run("apply", "l.npz", "z.png", "-o", "again.png").code == 0
    assert torch.equal(pixels("again.png"), pixels("x.png"))


@pytest.mark.parametrize(
    "line",
    [
        ("quilt", "z.png", *SIZE),
        ("quilt", "z.png", *SIZE, "--block", "9", "--overlap", "3", "--tolerance", "0.3"),
        ("quilt", "z.png", *SIZE, "--cut", "mincut", "--continuing"),
        ("quilt", "z.png", "grey.png", *SIZE, "--mask", "left.png", "--mask", "z.png"),
        ("quilt", "alpha.png", *SIZE, "--bits", "16"),
        ("quilt", "z.png", *OUT, "--target", "target.png"),
        ("quilt", "grey.png", *OUT, "--target", "target.png", "--iterations", "2"),
        ("patchwise", "z.png", *SIZE),
        ("patchwise", "z.png", *SIZE, "--patch", "9", "--overlap", "3", "--tolerance", "0.3"),
        ("patchwise", "z.png", *SIZE, "--search", "qtp"),
        ("patchwise", "grey.png", *SIZE, "--search", "exhaustive"),
        ("patchwise", "z.png", "grey.png", *SIZE, "--mask", "left.png", "--mask", "z.png"),
    ],
    ids=" ".join,
)
def test_repeat_gives_the_same_pixels(run: Run, here: Path, line: tuple[str, ...]) -> None:
    assert run(*line, "--seed", "3").code == 0
    assert run("repeat", "x.png", "-o", "y.png", "--quiet") == Done(0, "y.png\n", "")
    assert torch.equal(pixels("x.png"), pixels("y.png"))


@pytest.mark.parametrize("command", COMMANDS)
def test_threads_change_no_bit_and_seeds_do(run: Run, here: Path, command: str) -> None:
    for name, options in (("1", ()), ("2", ("--threads", "2")), ("3", ("--seed", "1"))):
        line = (command, "z.png", "-o", f"{name}.png", "--size", "40x44", "--quiet", *options)
        assert run(*line).code == 0
    assert torch.equal(pixels("1.png"), pixels("2.png"))
    assert not torch.equal(pixels("1.png"), pixels("3.png"))


@pytest.mark.parametrize("command", COMMANDS)
def test_masks_and_alpha_are_kept_to(run: Run, here: Path, command: str) -> None:
    line = (command, "alpha.png", *SIZE, "--labels", "l.npz")
    assert run(*line).code == 0
    assert SourceField.load("l.npz").positions[..., 2].min() >= 20
    assert run(command, "z.png", *SIZE, "--mask", "left.png", "--labels", "l.npz").code == 0
    assert SourceField.load("l.npz").positions[..., 2].max() < 20


def test_a_target_gives_the_size(run: Run, here: Path) -> None:
    assert run("quilt", "z.png", *OUT, "--target", "target.png", "--report", "r.json").code == 0
    assert pixels("x.png").shape == (3, 33, 21)
    report = json.loads(Path("r.json").read_text())
    assert report["settings"]["recipe"] == "transfer"
    assert set(report["files"]) == {"z.png", "target.png"}


BAD: list[tuple[str, tuple[str, ...]]] = [
    (words, (command, *line))
    for command, side in (("quilt", "block"), ("patchwise", "patch"))
    for words, line in (
        ("size='0x44'", ("z.png", *OUT, "--size", "0x44")),
        ("size='wide'", ("z.png", *OUT, "--size", "wide")),
        ("size=9999999x9999999 would need about", ("z.png", *OUT, "--size", "9999999x9999999")),
        ("size", ("z.png", *OUT)),
        (f"{side}=27 must lie in 3..26", ("z.png", *SIZE, f"--{side}", "27")),
        (f"{side}=0 must lie in 3..26", ("z.png", *SIZE, f"--{side}", "0")),
        (f"{side}=3 must lie in 3..1", ("pixel.png", *SIZE)),
        ("overlap=5 must be at least 1", ("z.png", *SIZE, f"--{side}", "10", "--overlap", "5")),
        ("overlap=0 must be at least 1", ("z.png", *SIZE, "--overlap", "0")),
        ("half of size=3x44", ("z.png", *OUT, "--size", "3x44", "--overlap", "2")),
        ("tolerance=-1.0", ("z.png", *SIZE, "--tolerance", "-1")),
        ("tolerance=nan", ("z.png", *SIZE, "--tolerance", "nan")),
        ("seed=-1", ("z.png", *SIZE, "--seed", "-1")),
        ("seed=9223372036854775808", ("z.png", *SIZE, "--seed", str(2**63))),
        ("bits=12", ("z.png", *SIZE, "--bits", "12")),
        ("mask: 1 given for 2", ("z.png", "grey.png", *SIZE, "--mask", "left.png")),
        ("mask='empty.png' is empty", ("z.png", *SIZE, "--mask", "empty.png")),
        ("mask='small.png' has 20 x 30", ("z.png", *SIZE, "--mask", "small.png")),
        ("mask='left.png' is white only", ("alpha.png", *SIZE, "--mask", "left.png")),
        ("fits nowhere in the masks", ("alpha.png", *SIZE, f"--{side}", "11")),
        ("exemplar='none.png': there is no such file", ("none.png", *SIZE)),
        ("exemplar='text.png'", ("text.png", *SIZE)),
        ("output='z.png' would overwrite", ("z.png", "-o", "z.png", "--size", "9x9")),
        ("labels='l.txt' must end", ("z.png", *SIZE, "--labels", "l.txt")),
        ("seams='s.psd' must end", ("z.png", *SIZE, "--seams", "s.psd")),
    )
] + [
    ("cut='dq' is unknown; choose dp, mincut", ("quilt", "z.png", *SIZE, "--cut", "dq")),
    ("search='ftt' is unknown", ("patchwise", "z.png", *SIZE, "--search", "ftt")),
    ("solver='ortools' belongs to cut=mincut", ("quilt", "z.png", *SIZE, "--solver", "ortools")),
    ("iterations=3 needs --target", ("quilt", "z.png", *SIZE, "--iterations", "3")),
    ("size: none given", ("quilt", "z.png", *OUT)),
    ("leave --size out", ("quilt", "z.png", *SIZE, "--target", "target.png")),
    ("continuing does not go", ("quilt", "z.png", *OUT, "--target", "target.png", "--continuing")),
    (
        "iterations=0 must be at least 1",
        ("quilt", "z.png", *OUT, "--target", "target.png", "--iterations", "0"),
    ),
    ("target='none.png': there is no such file", ("quilt", "z.png", *OUT, "--target", "none.png")),
    ("target='text.png'", ("quilt", "z.png", *OUT, "--target", "text.png")),
    (
        "would overwrite an input",
        ("quilt", "z.png", "-o", "target.png", "--quiet", "--target", "target.png"),
    ),
]


@pytest.mark.parametrize(("words", "line"), BAD, ids=[f"{b[0]} {w}" for w, b in BAD])
def test_bad_input_gets_one_sentence_and_code_2(
    run: Run, here: Path, words: str, line: tuple[str, ...]
) -> None:
    refused(run, here, words, *line)


def test_one_line_for_each_kind_of_step(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    done = run("quilt", "z.png", "-o", "x.png", "--target", "target.png")
    assert done.err.splitlines() == [f"iteration {i} of 3" for i in (1, 2, 3)]
    assert run("patchwise", "z.png", "-o", "x.png", "--size", "40x40").err == "patches\n"


@pytest.mark.parametrize("keep", [False, True])
def test_an_interrupt_leaves_a_whole_file_or_none(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch, keep: bool
) -> None:
    def quilt(*_: Any, on_step: Callable[[Stage], None], **options: Any) -> None:
        on_step(Stage(0.5, "blocks", torch.full((3, 40, 44), 0.5)))
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(quilting, "quilt", quilt)
    done = run("quilt", "z.png", *SIZE, *(["--keep-partial"] if keep else []))
    assert done.code == 130
    assert Path("x.png").exists() == keep
