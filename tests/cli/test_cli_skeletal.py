"""The command skeleton: what it writes and tells, that it can be repeated, bad input."""

import json
import sys
from pathlib import Path

import pytest
import torch
from conftest import Done, Run, pixels, refused

from torchtex import image as images

SIZE = ("-o", "x.png", "--size", "40x44", "--quiet")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with pictures, which is the current one."""
    monkeypatch.chdir(tmp_path)
    generator = torch.Generator().manual_seed(0)
    colour = images.resize(torch.rand(3, 9, 10, generator=generator), (36, 40)).clamp(0, 1)
    images.save("z.png", colour)
    images.save("grey.png", images.luminance(colour)[None])
    images.save("odd.png", colour[:, :35, :37])
    half = torch.zeros(1, 36, 40)
    images.save("empty.png", half)
    half[..., 12:] = 1
    images.save("right.png", half)
    images.save("small.png", half[:, :20])
    images.save("alpha.png", torch.cat([colour, 1 - half]))
    images.save("tiny.png", colour[:, :8, :8])
    Path("text.png").write_text("no picture")
    return tmp_path


def test_all_that_it_writes(run: Run, here: Path) -> None:
    done = run(
        "skeleton", "z.png", *SIZE, "--labels", "l.npz", "--report", "r.json", "--seams", "s.png",
        "--patch-map", "p.png",
    )  # fmt: skip
    assert done == Done(0, "x.png\n", "")
    assert pixels("x.png").shape == pixels("s.png").shape == pixels("p.png").shape == (3, 40, 44)
    report = json.loads(Path("r.json").read_text())
    assert report["command"] == "skeleton"
    assert report["settings"]["levels"] == 1
    assert run("apply", "l.npz", "z.png", "-o", "again.png").code == 0
    assert torch.equal(pixels("again.png"), pixels("x.png"))


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--levels", "2", "--cut", "none"),
        ("--wavelet", "db2", "--phases", "2"),
        ("--boundary", "periodic", "--seed", "5", "--feature", "haar"),
        ("--mask", "right.png", "--bits", "16"),
        ("--solver", "ortools", "--refine", "1"),
        ("--no-mend", "--levels", "2"),
    ],
    ids=" ".join,
)
def test_repeat_gives_the_same_bits(run: Run, here: Path, options: tuple[str, ...]) -> None:
    assert run("skeleton", "z.png", *SIZE, *options).code == 0
    assert run("repeat", "x.png", "-o", "y.png", "--quiet", "--threads", 2) == Done(
        0, "y.png\n", ""
    )
    assert torch.equal(pixels("x.png"), pixels("y.png"))


def test_several_exemplars_grey_beside_colour_and_transparent(run: Run, here: Path) -> None:
    assert run("skeleton", "z.png", "grey.png", "alpha.png", *SIZE).code == 0
    assert pixels("x.png").shape == (3, 40, 44)


def test_the_mask_is_kept(run: Run, here: Path) -> None:
    assert run("skeleton", "z.png", *SIZE, "--mask", "right.png", "--labels", "l.npz").code == 0
    assert run("apply", "l.npz", "right.png", "-o", "m.png").code == 0
    assert bool((pixels("m.png") == 1).all())


def test_the_refined_texture_has_labels_too(run: Run, here: Path) -> None:
    assert run("skeleton", "z.png", *SIZE, "--refine", "1", "--labels", "l.npz").code == 0
    assert run("apply", "l.npz", "z.png", "-o", "again.png").code == 0
    assert torch.equal(pixels("again.png"), pixels("x.png"))


def test_without_mending_all_pixels_are_copies(run: Run, here: Path) -> None:
    assert run("skeleton", "z.png", *SIZE, "--no-mend").code == 0
    found = {tuple(pixel) for pixel in pixels("x.png").flatten(1).T.tolist()}
    assert found <= {tuple(pixel) for pixel in pixels("z.png").flatten(1).T.tolist()}


def test_odd_sizes_are_told(run: Run, here: Path) -> None:
    options = ("-o", "x.png", "--size", "41x44", "--levels", "2")
    done = run("skeleton", "odd.png", *options)
    assert done.code == 0
    assert "size=41x44 is made as 44x44 and cropped\n" in done.err
    assert (
        "exemplar='odd.png': the last 3 rows and 1 columns fill no block of 4 pixels and are left "
        "out\n" in done.err
    )
    assert pixels("x.png").shape == (3, 41, 44)
    assert run("skeleton", "odd.png", *options, "--quiet").err == ""


BAD: list[tuple[str, tuple[str, ...]]] = [
    ("levels=0 must lie in 1..3", ("z.png", *SIZE, "--levels", "0")),
    ("levels=4 must lie in 1..3", ("z.png", *SIZE, "--levels", "4")),
    ("--levels", ("z.png", *SIZE, "--levels", "one")),
    ("levels=3 is too many for exemplar=36x40", ("z.png", *SIZE, "--levels", "3")),
    ("levels=1 is too many for exemplar=8x8", ("tiny.png", *SIZE)),
    ("levels=2 is too many for size=8x44", ("z.png", *SIZE, "--levels", "2", "--size", "8x44")),
    ("wavelet='hear' is unknown", ("z.png", *SIZE, "--wavelet", "hear")),
    ("wavelet='bior2.2' is not orthogonal", ("z.png", *SIZE, "--wavelet", "bior2.2")),
    ("phases=3 must be a power of 2", ("z.png", *SIZE, "--phases", "3")),
    ("feature='pixel' is unknown; did you mean pixels?", ("z.png", *SIZE, "--feature", "pixel")),
    ("cut='dp' is unknown", ("z.png", *SIZE, "--cut", "dp")),
    ("solver='ortools' belongs to", ("z.png", *SIZE, "--solver", "ortools", "--cut", "none")),
    ("solver='maxflow' is unknown", ("z.png", *SIZE, "--solver", "maxflow")),
    ("refine=-1 must lie in 0..100", ("z.png", *SIZE, "--refine", "-1")),
    ("refine=101 must lie in 0..100", ("z.png", *SIZE, "--refine", "101")),
    ("seams shows pieces", ("z.png", *SIZE, "--refine", "1", "--seams", "s.png")),
    ("patch_map shows pieces", ("z.png", *SIZE, "--refine", "1", "--patch-map", "s.png")),
    ("boundary='open' is unknown", ("z.png", *SIZE, "--boundary", "open")),
    (
        "size=41x44 with a periodic boundary must be a multiple",
        ("z.png", *SIZE, "--boundary", "periodic", "--size", "41x44"),
    ),
    ("size='0x44'", ("z.png", *SIZE, "--size", "0x44")),
    ("size=9999999x9999999 would need", ("z.png", *SIZE, "--size", "9999999x9999999")),
    ("seed=-1", ("z.png", *SIZE, "--seed", "-1")),
    ("bits=12 must be 8 or 16", ("z.png", *SIZE, "--bits", "12")),
    ("mask: 1 given for 2", ("z.png", "grey.png", *SIZE, "--mask", "right.png")),
    ("mask='empty.png' is empty", ("z.png", *SIZE, "--mask", "empty.png")),
    ("mask='small.png' has 20 x 40", ("z.png", *SIZE, "--mask", "small.png")),
    ("exemplar='text.png' is none of", ("text.png", *SIZE)),
    ("exemplar='none.png': there is no such file", ("none.png", *SIZE)),
    ("output='z.png' would overwrite an input", ("z.png", *SIZE, "-o", "z.png")),
    ("patch_map='x.png' is another output", ("z.png", *SIZE, "--patch-map", "x.png")),
    ("output='no/x.png': there is no folder", ("z.png", *SIZE, "-o", "no/x.png")),
]


@pytest.mark.parametrize(("words", "arguments"), BAD, ids=[words for words, _ in BAD])
def test_bad_input_gets_one_sentence_and_code_2(
    run: Run, here: Path, words: str, arguments: tuple[str, ...]
) -> None:
    refused(run, here, words, "skeleton", *arguments)


def test_without_a_solver_it_says_what_to_install(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "maxflow", None)
    for name in ("ortools", "ortools.graph", "ortools.graph.python"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, "ortools.graph.python.max_flow", None)
    refused(run, here, "torchtex[graphcut]", "skeleton", "z.png", *SIZE)
    assert run("skeleton", "z.png", *SIZE, "--cut", "none").code == 0


def test_maps_of_longer_wavelets_blend_across_seams_as_the_texture_does(
    run: Run, here: Path
) -> None:
    line = ("skeleton", "z.png", "--size", "40x48", "--wavelet", "db2", "--no-mend", "--quiet")
    assert run(*line, "-o", "x.png", "--labels", "x.npz").code == 0
    assert run("apply", "x.npz", "z.png", "-o", "y.png").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))
