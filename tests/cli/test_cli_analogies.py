"""`torchtex analogy`: all methods, ways to an analogy, repeat, sentences for bad input."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Done, Run, noise, pixels, refused, stripes
from torch import Tensor

from torchtex import image as images


def regions(h: int, w: int, first: float, second: float) -> Tensor:
    return torch.where(torch.arange(w) < w // 2, first, second).double().expand(3, h, w)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with pictures, which is the current one."""
    monkeypatch.chdir(tmp_path)
    maps = regions(40, 48, 0.0, 1.0)
    images.save("s.png", torch.where(maps > 0, noise(3, 40, 48), stripes(40, 48) * 0.5))
    images.save("q.png", maps)
    images.save("c.png", regions(32, 36, 1.0, 0.0))
    images.save("soft.png", regions(32, 36, 0.97, 0.03))
    images.save("odd.png", regions(32, 36, 0.4, 0.0))
    images.save("small.png", noise(3, 8, 9, seed=2))
    images.save("t.png", noise(3, 40, 44, seed=3))
    images.save("wide.png", maps[:, :, :40])
    images.save("grey.png", noise(1, 32, 36))
    Path("text.png").write_text("no picture")
    return tmp_path


BASE = ("--source", "s.png", "--mapped", "q.png", "--constraint", "c.png", "-o", "x.png")
QUICK = ("--n", "2", "--no-turns")
WAYS: list[tuple[str, ...]] = [
    ("--method", "cms", *QUICK),
    ("--method", "cms", "-K", "0.5", "-N", "2", "--mirrors", "--match-luminance"),
    ("--method", "cms", *QUICK, "--paper", "--tolerance", "5"),
    ("--method", "analogies", "--kappa", "1"),
    ("--method", "quilt", "--bits", "16"),
    ("--method", "random", "--moves", "5", *QUICK, "--seed", "4"),
    ("--method", "em"),
]


@pytest.mark.parametrize("options", WAYS, ids=" ".join)
def test_every_method_and_its_repetition(run: Run, here: Path, options: tuple[str, ...]) -> None:
    done = run("analogy", *BASE, *options, "--quiet", "--labels", "l.npz", "--report", "r.json")
    assert done == Done(0, "x.png\n", "")
    assert pixels("x.png").shape == (3, 32, 36)
    again = run("repeat", "x.png", "-o", "y.png", "--quiet")
    assert again.code == 0, again.err
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    about = json.loads(Path("r.json").read_text())
    assert ("energies" in about) == (options[1] in ("cms", "random"))
    assert run("apply", "l.npz", "q.png", "-o", "m.png").code == 0
    wrong = (pixels("m.png") - pixels("c.png")).abs().mean()
    assert wrong < 0.3
    if "--match-luminance" not in options:
        assert run("apply", "l.npz", "s.png", "-o", "same.png", "--bits", "8").code == 0
        assert (pixels("same.png") - pixels("x.png")).abs().max() < 1.01 / 255


def test_several_sources_constraints_and_weights(run: Run, here: Path) -> None:
    names = [f"--{kind}={name}.png" for kind, name in (
        ("source", "s"), ("source", "t"), ("mapped", "q"), ("mapped", "s"), ("mapped", "t"),
        ("mapped", "t"), ("constraint", "c"), ("constraint", "soft"),
    )]  # fmt: skip
    done = run(
        "analogy", *names, "--weight=1", "--weight=0.1", "--method=analogies", "-o", "x.png",
        "--labels", "l.npz", "--patch-map", "p.png",
    )  # fmt: skip
    assert done.code == 0, done.err
    assert run("apply", "l.npz", "s.png", "t.png", "-o", "same.png").code == 0
    assert torch.equal(pixels("same.png"), pixels("x.png"))
    assert pixels("p.png").shape == (3, 32, 36)
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))


def test_detail_tells_how_far_off_it_is(run: Run, here: Path) -> None:
    given = ("analogy", "--source", "t.png", "--constraint", "small.png", "-o", "x.png")
    done = run(*given, "--detail", "4", "-K", "7", *QUICK, "--report", "r.json")
    assert done.code == 0, done.err
    last = done.err.splitlines()[-1]
    assert last.startswith("reduced again, the output is ")
    assert " % with its colours corrected; it is " in last
    assert pixels("x.png").shape == (3, 32, 36)
    about = json.loads(Path("r.json").read_text())
    assert about["detail_error"] < about["detail_error_of_copies"] / 2 < 0.15
    assert about["sharpness"] > 0.5
    assert run("repeat", "x.png", "-o", "y.png", "--quiet") == Done(0, "y.png\n", "")
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    more = ("--method", "analogies", "--report", "r.json", "--no-back-project")
    done = run(*given, "--detail", "4", *more)
    assert done.code == 0, done.err
    assert "raise K, or give a sample more alike" in done.err.splitlines()[-1]
    about = json.loads(Path("r.json").read_text())
    assert about["detail_error"] == about["detail_error_of_copies"] > 0.02
    assert run("repeat", "x.png", "-o", "y.png", "--quiet") == Done(0, "y.png\n", "")
    assert torch.equal(pixels("x.png"), pixels("y.png"))


@pytest.mark.parametrize("more", [("--moves", "5", "--method", "random"), ("--paper",)])
def test_masked_pixels_of_the_source_are_not_copied(
    run: Run, here: Path, more: tuple[str, ...]
) -> None:
    white = torch.ones(1, 40, 48)
    white[:, :, ::5] = 0
    images.save("m.png", white)
    done = run("analogy", *BASE, *more, *QUICK, "--mask", "m.png", "--labels", "l.npz", "--quiet")
    assert done == Done(0, "x.png\n", "")
    assert run("apply", "l.npz", "m.png", "-o", "used.png").code == 0
    assert bool((pixels("used.png") == 1).all())
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))


def test_a_partial_picture_of_em_has_the_whole_size(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchtex.cli.base import Watch

    plain = Watch.__call__

    def stopped(self: Watch, progress: Any) -> None:
        plain(self, progress)
        raise KeyboardInterrupt

    monkeypatch.setattr(Watch, "__call__", stopped)
    done = run("analogy", *BASE, "--method", "em", "--keep-partial", "--quiet")
    assert done.code == 130
    assert pixels("x.png").shape == (3, 32, 36)


def test_transfer_and_its_blur(run: Run, here: Path) -> None:
    given = ("analogy", "--source", "s.png", "--constraint", "grey.png", "-o", "x.png", "--quiet")
    for more in ((), ("--blur", "1.5"), ("--match-luminance", "--contrast", "1.8")):
        done = run(*given, "--transfer", "--method", "analogies", *more)
        assert done == Done(0, "x.png\n", ""), done.err
        assert pixels("x.png").shape == (3, 32, 36)


def test_numbers_tells_how_many_pixels_were_snapped(run: Run, here: Path) -> None:
    soft = [word.replace("c.png", "soft.png") for word in BASE]
    done = run("analogy", *soft, "--numbers", "--method", "analogies")
    assert done.code == 0, done.err
    lines = [line for line in done.err.splitlines() if line.startswith("numbers: ")]
    assert lines == ["numbers: 0 pixels of mapped and 1152 of constraint were snapped to 2 colours"]
    before = pixels("x.png")
    assert run("analogy", *BASE, "--numbers", "--method", "analogies", "--quiet").err == ""
    assert torch.equal(pixels("x.png"), before)


@pytest.mark.parametrize("given", [("--sweep", "K=0.5,2", "N=1,3"), ("--sweep=K=0.5,2,N=1,3",)])
def test_a_sweep_is_a_sheet_with_names(run: Run, here: Path, given: tuple[str, ...]) -> None:
    done = run("analogy", *BASE, *given, "--no-turns", "--report", "r.json")
    assert done.code == 0, done.err
    sheet = pixels("x.png")
    assert sheet.shape == (3, 22 + 2 * (32 + 6), 64 + 2 * (36 + 6))
    assert (sheet[:, 22:54, :64] < 0.5).any()  # K 0.5
    assert (sheet[:, :22, 64:100] < 0.5).any()  # N 1
    runs = json.loads(Path("r.json").read_text())["runs"]
    assert [(one["K"], one["N"]) for one in runs] == [(0.5, 1), (0.5, 3), (2, 1), (2, 3)]
    assert done.err.splitlines()[-1] == "picture 4 of 4"
    assert run("analogy", *BASE, "-K", "2", "-N", "3", "--no-turns", "--quiet").code == 0
    last = sheet[:, 22 + 38 : 22 + 38 + 32, 64 + 42 : 64 + 42 + 36]
    assert torch.equal(last, pixels("x.png"))


def test_a_sweep_is_repeated(run: Run, here: Path) -> None:
    assert run("analogy", *BASE, "--sweep", "K=0.5,2", "N=2", "--no-turns", "--quiet").code == 0
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))


def test_the_curve_of_the_energy(run: Run, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    done = run("analogy", *BASE, *QUICK, "--curve", "e.png")
    assert done.code == 0, done.err
    assert pixels("e.png").shape == (3, 400, 700)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    done = run("analogy", *BASE, *QUICK, "--curve", "f.png")
    told = "torchtex: curve: matplotlib is not installed; pip install 'torchtex[plot]'\n"
    assert done == Done(2, "", told)


def other(**changes: str | None) -> tuple[str, ...]:
    """The arguments of `BASE`, with other files or without one."""
    files: dict[str, str | None] = {"source": "s.png", "mapped": "q.png", "constraint": "c.png"}
    files |= changes
    pairs = [(f"--{kind}", name) for kind, name in files.items() if name is not None]
    return (*(word for pair in pairs for word in pair), "-o", "x.png")


BAD: list[tuple[str, tuple[str, ...]]] = [
    ("mapped is 40x40 and its source 40x48", other(mapped="wide.png")),
    ("constraint has colours that mapped has not: (102, 102, 102)",
     (*other(constraint="odd.png"), "--numbers")),
    ("exemplar='sgravel' is no file and no bundled exemplar", other(source="sgravel")),
    ("mapped: 1 given for 2 sources and 1 constraints; repeat --mapped 2 times",
     (*BASE, "--source", "t.png")),
    ("mapped: 0 given for 1 sources", other(mapped=None)),
    ("mapped has 3 channels and its constraint 1", other(constraint="grey.png")),
    ("source: one has 1 channels and another 3",
     (*BASE, "--source", "grey.png", "--mapped", "c.png")),
    ("k=-1.0 must be at least 0", (*BASE, "--k=-1")),
    ("k=inf", (*BASE, "-K", "inf")),
    ("n=0 must be at least 1", (*BASE, "--n", "0")),
    ("n=16 makes windows of 33 pixels, and the shortest side of the images is 32",
     (*BASE, "-N", "16")),
    ("method='cmss' is unknown; did you mean cms", (*BASE, "--method", "cmss")),
    ("k=2.0 is of the methods cms, random", (*BASE, "--method", "em", "-K", "2")),
    ("turns=False is of the methods", (*BASE, "--method", "quilt", "--no-turns")),
    ("kappa=3.0 is of the methods analogies", (*BASE, "--kappa", "3")),
    ("kappa=-1", (*BASE, "--method", "analogies", "--kappa=-1")),
    ("moves=5 is of the methods random", (*BASE, "--moves", "5")),
    ("curve=e.png is of the methods", (*BASE, "--method", "quilt", "--curve", "e.png")),
    ("detail=1.5 must be at least 2", (*other(mapped=None), "--detail", "1.5")),
    ("detail=nan must be at least 2", (*other(mapped=None), "--detail", "nan")),
    ("sample is 8x9, less than factor=20",
     (*other(mapped=None, source="small.png", constraint="small.png"), "--detail", "20")),
    ("mapped='q.png': detail makes it", (*BASE, "--detail", "2")),
    ("mapped='q.png': transfer makes it", (*BASE, "--transfer")),
    ("transfer does not go with numbers", (*BASE, "--transfer", "--numbers")),
    ("constraint: 2 given; transfer takes one",
     (*other(mapped=None), "--constraint", "soft.png", "--transfer")),
    ("source: 2 given; numbers takes one", (*BASE, "--source", "t.png", "--numbers")),
    ("back_project needs --detail", (*BASE, "--back-project")),
    ("blur=2.0 needs --transfer", (*BASE, "--blur", "2")),
    ("contrast=2.0 needs --transfer", (*BASE, "--contrast", "2")),
    ("contrast=0.0 must be above 0", (*other(mapped=None), "--transfer", "--contrast=0")),
    ("tolerance=-1.0 must be at least 0", (*BASE, "--tolerance=-1")),
    ("tolerance=1.0 is of the methods cms", (*BASE, "--method", "em", "--tolerance=1")),
    ("paper=True is of the methods cms", (*BASE, "--method", "random", "--paper")),
    ("mask=q.png is of the methods", (*BASE, "--method", "em", "--mask", "q.png")),
    ("mask: 2 given for 1", (*BASE, "--mask", "q.png", "--mask", "q.png")),
    ("mask='none.png': there is no such file", (*BASE, "--mask", "none.png")),
    ("blur=-2.0 must be at least 0", (*other(mapped=None), "--transfer", "--blur=-2")),
    ("match_luminance does not go with numbers", (*BASE, "--numbers", "--match-luminance")),
    ("weights: 2 given for 1 constraints", (*BASE, "--weight", "1", "--weight", "2")),
    ("weights=0.0 must be above 0", (*BASE, "--weight", "0")),
    ("constraint: one is 40x44 and another 32x36",
     (*BASE, "--constraint", "t.png", "--mapped", "q.png")),
    ("sweep='K=a' must be such as", (*BASE, "--sweep", "K=a")),
    ("sweep='M=1,2' must be such as", (*BASE, "--sweep", "M=1,2")),
    ("sweep='N=1.5': N must be whole", (*BASE, "--sweep", "N=1.5")),
    ("makes 49 pictures", (*BASE, "--sweep", "K=1,2,3,4,5,6,7,N=1,2,3,4,5,6,7")),
    ("n=30 makes windows", (*BASE, "--sweep", "K=1,N=2,30")),
    ("k=2.0 is swept", (*BASE, "--k", "2", "--sweep", "K=1,2")),
    ("sweep=K=1,2 is of the methods", (*BASE, "--method", "em", "--sweep", "K=1,2")),
    ("labels='l.npz' is of one picture", (*BASE, "--sweep", "K=1,2", "--labels", "l.npz")),
    ("argument 'N=2' belongs to --sweep", (*BASE, "N=2")),
    ("mapped='none.png': there is no such file", other(mapped="none.png")),
    ("constraint='text.png' is none of", other(constraint="text.png")),
    ("source='none.png': there is no such file", other(source="none.png")),
    ("seed=-1 must lie in", (*BASE, "--seed", "-1")),
    ("output='c.png' would overwrite an input", (*BASE, "-o", "c.png")),
    ("labels='l.txt' must end in .npz", (*BASE, "--labels", "l.txt")),
    ("bits=9", (*BASE, "--bits", "9")),
]  # fmt: skip


@pytest.mark.parametrize(("words", "arguments"), BAD, ids=[words for words, _ in BAD])
def test_bad_input_gets_one_sentence_and_code_2(
    run: Run, here: Path, words: str, arguments: tuple[str, ...]
) -> None:
    refused(run, here, words, "analogy", *arguments, "--quiet")


def test_help(run: Run) -> None:
    assert "Usage: torchtex analogy" in run("analogy", "--help").out
