"""The command graphcut: what it writes, that it can be repeated, sentences for bad input."""

import json
import sys
from pathlib import Path

import pytest
import torch
from conftest import Done, Run, pixels, refused

import torchtex.cuts.mincut as mincut
from torchtex import image as images

SIZE = ("-o", "x.png", "--size", "40x44", "--quiet")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with pictures, which is the current one."""
    monkeypatch.chdir(tmp_path)
    generator = torch.Generator().manual_seed(0)
    colour = images.resize(torch.rand(3, 8, 9, generator=generator), (26, 30)).clamp(0, 1)
    images.save("z.png", colour)
    images.save("grey.png", images.luminance(colour)[None])
    half = torch.zeros(1, 26, 30)
    images.save("empty.png", half)
    half[..., :20] = 1
    images.save("left.png", half)
    images.save("small.png", half[:, :20])
    images.save("alpha.png", torch.cat([colour, 1 - half]))
    Path("text.png").write_text("no picture")
    return tmp_path


def test_all_that_it_writes(run: Run, here: Path) -> None:
    done = run(
        "graphcut", "z.png", *SIZE, "--labels", "l.npz", "--report", "r.json", "--seams", "s.png",
        "--patch-map", "p.png",
    )  # fmt: skip
    assert done == Done(0, "x.png\n", "")
    assert pixels("x.png").shape == pixels("s.png").shape == pixels("p.png").shape == (3, 40, 44)
    report = json.loads(Path("r.json").read_text())
    assert report["command"] == "graphcut"
    assert report["settings"]["seam_cost"] <= report["settings"]["seam_cost_before_refinement"]
    assert run("apply", "l.npz", "z.png", "-o", "again.png").code == 0
    assert torch.equal(pixels("again.png"), pixels("x.png"))


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--placement", "random"),
        ("--placement", "entire", "--k", "0.1", "--no-gradient"),
        ("--patch", "9", "--k", "0.002", "--spread", "1", "--refine", "3"),
        ("--turns", "--mirrors", "--scales", "0.8,1,1.25"),
        ("--poisson", "--boundary", "periodic", "--seed", "5"),
        ("--mask", "left.png", "--bits", "16"),
        ("--solver", "ortools"),
        ("--solver", "pymaxflow"),
    ],
    ids=" ".join,
)
def test_repeat_gives_the_same_bits(run: Run, here: Path, options: tuple[str, ...]) -> None:
    if "--solver" in options and not mincut.solvers()[options[-1]]:
        pytest.skip(f"{options[-1]} is not installed")
    assert run("graphcut", "z.png", *SIZE, *options, "--seams", "s.png").code == 0
    for name in ("s.png",):
        Path(name).unlink()
    assert run("repeat", "x.png", "-o", "y.png", "--quiet", "--threads", 2) == Done(
        0, "y.png\n", ""
    )
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    assert not Path("s.png").exists()


def test_several_exemplars_grey_beside_colour_and_transparent(run: Run, here: Path) -> None:
    assert run("graphcut", "z.png", "grey.png", "alpha.png", *SIZE).code == 0
    assert pixels("x.png").shape == (3, 40, 44)


def test_a_bundled_exemplar_larger_than_the_texture(run: Run, here: Path) -> None:
    assert run("graphcut", "gravel", *SIZE).code == 0
    assert pixels("x.png").shape == (1, 40, 44)


def test_the_mask_is_kept(run: Run, here: Path) -> None:
    assert run("graphcut", "z.png", *SIZE, "--mask", "left.png", "--labels", "l.npz").code == 0
    assert run("apply", "l.npz", "left.png", "-o", "m.png").code == 0
    assert bool((pixels("m.png") == 1).all())


BAD: list[tuple[str, tuple[str, ...]]] = [
    ("patch=27 is larger than an exemplar", ("z.png", *SIZE, "--patch", "27")),
    ("patch=22 is larger than size=20x44", ("z.png", *SIZE, "--patch", "22", "--size", "20x44")),
    ("patch=15 is larger than an exemplar", ("z.png", *SIZE, "--patch", "15", "--scales", ".5")),
    ("patch=0 must be", ("z.png", *SIZE, "--patch", "0")),
    ("patch=-3 must be", ("z.png", *SIZE, "--patch", "-3")),
    ("patch=9 belongs to", ("z.png", *SIZE, "--patch", "9", "--placement", "entire")),
    ("placement='subs' is unknown; did you mean sub?", ("z.png", *SIZE, "--placement", "subs")),
    ("k=0.0 must be above 0", ("z.png", *SIZE, "--k", "0")),
    ("k=nan must be above 0", ("z.png", *SIZE, "--k", "nan", "--placement", "entire")),
    ("k=1.0 belongs to", ("z.png", *SIZE, "--k", "1", "--placement", "random")),
    ("spread=-1.0", ("z.png", *SIZE, "--spread", "-1")),
    ("spread=1.0 belongs to", ("z.png", *SIZE, "--spread", "1", "--placement", "random")),
    ("refine=-1", ("z.png", *SIZE, "--refine", "-1")),
    ("--refine", ("z.png", *SIZE, "--refine", "many")),
    ("scales=0.0 must lie", ("z.png", *SIZE, "--scales", "1,0")),
    ("scales='-1' must be", ("z.png", *SIZE, "--scales=-1")),
    ("scales='1,,2' must be", ("z.png", *SIZE, "--scales", "1,,2")),
    ("scales='nan' must be", ("z.png", *SIZE, "--scales", "nan")),
    ("scales=99.0 must lie", ("z.png", *SIZE, "--scales", "99")),
    (
        "solver='maxflow' is unknown; those installed here: ",
        ("z.png", *SIZE, "--solver", "maxflow"),
    ),
    ("boundary='open' is unknown", ("z.png", *SIZE, "--boundary", "open")),
    ("size='0x44'", ("z.png", *SIZE, "--size", "0x44")),
    ("size=9999999x9999999 would need", ("z.png", *SIZE, "--size", "9999999x9999999")),
    ("seed=-1", ("z.png", *SIZE, "--seed", "-1")),
    ("bits=12 must be 8 or 16", ("z.png", *SIZE, "--bits", "12")),
    ("mask: 1 given for 2", ("z.png", "grey.png", *SIZE, "--mask", "left.png")),
    ("mask='empty.png' is empty", ("z.png", *SIZE, "--mask", "empty.png")),
    ("mask='small.png' has 20 x 30", ("z.png", *SIZE, "--mask", "small.png")),
    ("mask='left.png' is white only", ("alpha.png", *SIZE, "--mask", "left.png")),
    ("exemplar='text.png' is none of", ("text.png", *SIZE)),
    ("exemplar='none.png': there is no such file", ("none.png", *SIZE)),
    ("output='z.png' would overwrite an input", ("z.png", *SIZE, "-o", "z.png")),
    ("seams='z.png' would overwrite", ("z.png", *SIZE, "--seams", "z.png")),
    ("patch_map='x.png' is another output", ("z.png", *SIZE, "--patch-map", "x.png")),
    ("output='no/x.png': there is no folder", ("z.png", *SIZE, "-o", "no/x.png")),
    ("--turn", ("z.png", *SIZE, "--turn", "90")),
]


@pytest.mark.parametrize(("words", "arguments"), BAD, ids=[words for words, _ in BAD])
def test_bad_input_gets_one_sentence_and_code_2(
    run: Run, here: Path, words: str, arguments: tuple[str, ...]
) -> None:
    refused(run, here, words, "graphcut", *arguments)


@pytest.mark.parametrize("solver", [(), ("--solver", "pymaxflow"), ("--solver", "ortools")])
def test_a_solver_that_is_not_installed(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch, solver: tuple[str, ...]
) -> None:
    monkeypatch.setitem(sys.modules, "maxflow", None)
    for name in ("ortools", "ortools.graph", "ortools.graph.python"):
        monkeypatch.setitem(sys.modules, f"{name}", None)
    monkeypatch.setitem(sys.modules, "ortools.graph.python.max_flow", None)
    words = "pip install 'torchtex[graphcut]'"
    refused(run, here, words, "graphcut", "z.png", *SIZE, *solver)
