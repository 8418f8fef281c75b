"""`torchtex cyclic`, `wang` and `wang-tile`: results, repeat, sentences for bad input."""

import json
from pathlib import Path

import pytest
import torch
from conftest import Done, Run, noise, pixels, refused, stripes

from torchtex import image as images


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with pictures, which is the current one."""
    monkeypatch.chdir(tmp_path)
    images.save("z.png", stripes(40, 48))
    images.save("grey.png", noise(1, 40, 48))
    images.save("tiny.png", noise(3, 3, 48))
    alpha = torch.ones(1, 40, 48, dtype=torch.float64)
    alpha[..., :20] = 0
    images.save("alpha.png", torch.cat([stripes(40, 48), alpha]))
    Path("text.png").write_text("no picture")
    Path("folder_2x2.png").mkdir()
    return tmp_path


WANG = ("--tile", "16", "--quiet")


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--overlap", "8x12"),
        ("--cut", "dp"),
        ("--opening", "half", "--poisson"),
        ("--bits", "16"),
    ],
    ids=" ".join,
)
def test_cyclic_and_its_repetition(run: Run, here: Path, options: tuple[str, ...]) -> None:
    assert run("cyclic", "z.png", "-o", "x.png", "--quiet", *options) == Done(0, "x.png\n", "")
    if "--overlap" in options:
        assert pixels("x.png").shape == (3, 32, 36)
    done = run("repeat", "x.png", "-o", "y.png", "--quiet")
    assert done.code == 0, done.err
    assert torch.equal(pixels("x.png"), pixels("y.png"))


def test_cyclic_previews_maps_and_pictures(run: Run, here: Path) -> None:
    extra = ("--seams", "s.png", "--patch-map", "p.png", "--report", "r.json")
    done = run(
        "cyclic", "grey.png", "-o", "x.png", "--overlap", "8x12", "--preview", "3x2",
        "--labels", "l.npz", *extra,
    )  # fmt: skip
    assert done.code == 0, done.err
    assert done.err.splitlines() == ["cut across", "cut down", "open"]
    assert torch.equal(pixels("x_3x2.png"), pixels("x.png").repeat(1, 3, 2))
    assert run("apply", "l.npz", "grey.png", "-o", "same.png").code == 0
    assert torch.equal(pixels("same.png"), pixels("x.png"))
    assert json.loads(Path("r.json").read_text())["settings"]["overlap"] == [8, 12]
    assert pixels("s.png").shape == pixels("p.png").shape == (3, 32, 36)


@pytest.mark.parametrize(
    ("options", "shape"),
    [
        ((), (3, 32, 64)),
        (("--complete", "--bits", "16"), (3, 64, 64)),
        (("--colors", "3", "--cut", "dp"), (3, 48, 96)),
    ],
)
def test_wang_sets_and_their_repetition(
    run: Run, here: Path, options: tuple[str, ...], shape: tuple[int, ...]
) -> None:
    done = run("wang", "z.png", "-o", "a.png", *WANG, "--seed", "3", *options)
    assert done == Done(0, "a.png\n", "")
    assert pixels("a.png").shape == shape
    assert run("repeat", "a.png", "-o", "b.png", "--quiet").code == 0
    assert torch.equal(pixels("a.png"), pixels("b.png"))
    for name in ("a", "b"):
        done = run(
            "wang-tile", f"{name}.png", "-o", f"{name}t.png", "--size", "50x70", "--seed", "5",
            "--bits", "16", "--labels", f"{name}.npz",
        )  # fmt: skip
        assert done.code == 0, done.err
    assert pixels("at.png").shape == (3, 50, 70)
    assert torch.equal(pixels("at.png"), pixels("bt.png"))
    assert run("repeat", "at.png", "-o", "again.png", "--quiet").code == 0
    assert torch.equal(pixels("at.png"), pixels("again.png"))
    assert run("apply", "a.npz", "z.png", "-o", "same.png", "--bits", "16").code == 0
    assert torch.equal(pixels("at.png"), pixels("same.png"))
    assert run("wang-tile", "a.png", "-o", "c.png", "--size", "50x70", "--seed", "6").code == 0
    assert not torch.equal(pixels("at.png"), pixels("c.png"))


def test_wang_leaves_transparent_pixels_out(run: Run, here: Path) -> None:
    done = run("wang", "alpha.png", "-o", "a.png", *WANG, "--labels", "l.npz", "--seams", "s.png")
    assert done.code == 0, done.err
    from torchtex.sources import SourceField

    assert SourceField.load("l.npz").source_map()[..., 2].min() >= 20


X = ("-o", "x.png", "--size", "9x9")
BAD: list[tuple[str, tuple[str, ...]]] = [
    ("overlap=21x12: of the 40 rows", ("cyclic", "z.png", "-o", "x.png", "--overlap", "21x12")),
    ("overlap=12x25: of the 48 columns", ("cyclic", "z.png", "-o", "x.png", "--overlap", "12x25")),
    ("overlap=1x8", ("cyclic", "z.png", "-o", "x.png", "--overlap", "1x8")),
    ("overlap='wide' must be best, or", ("cyclic", "z.png", "-o", "x.png", "--overlap", "wide")),
    ("texture of 3x48 is too small", ("cyclic", "tiny.png", "-o", "x.png")),
    ("texture='text.png' is none of", ("cyclic", "text.png", "-o", "x.png")),
    ("texture='none.png': there is no such file", ("cyclic", "none.png", "-o", "x.png")),
    ("cut='graph' is unknown", ("cyclic", "z.png", "-o", "x.png", "--cut", "graph")),
    ("opening='third' is unknown", ("cyclic", "z.png", "-o", "x.png", "--opening", "third")),
    ("preview='3' must be", ("cyclic", "z.png", "-o", "x.png", "--preview", "3")),
    ("preview='3x99' may have", ("cyclic", "z.png", "-o", "x.png", "--preview", "3x99")),
    ("preview='folder_2x2.png'", ("cyclic", "z.png", "-o", "folder.png", "--preview", "2x2")),
    ("output='z.png' would overwrite", ("cyclic", "z.png", "-o", "z.png")),
    ("output='x.psd' must end in", ("cyclic", "z.png", "-o", "x.psd")),
    ("bits=12", ("cyclic", "z.png", "-o", "x.png", "--bits", "12")),
    ("colors=4 must be 2 or 3", ("wang", "z.png", "-o", "x.png", *WANG, "--colors", "4")),
    ("tile=64 needs 80 pixels a side", ("wang", "z.png", "-o", "x.png")),
    ("tile=15 must be even", ("wang", "z.png", "-o", "x.png", "--tile", "15")),
    ("mask leaves no place", ("wang", "alpha.png", "-o", "x.png", "--tile", "30")),
    ("cut='path' is unknown", ("wang", "z.png", "-o", "x.png", *WANG, "--cut", "path")),
    ("seed=-1 must lie in", ("wang", "z.png", "-o", "x.png", *WANG, "--seed", "-1")),
    ("output='x.jpg' must end in .png", ("wang", "z.png", "-o", "x.jpg", *WANG)),
    ("output='z.png' would overwrite", ("wang", "z.png", "-o", "z.png", *WANG)),
    ("edges='x.json' is another", ("wang", "z.png", "-o", "x.png", "--report", "x.json")),
    ("exemplar='none.png'", ("wang", "none.png", "-o", "x.png")),
    ("atlas='none.png': there is no such", ("wang-tile", "none.png", *X)),
    ("atlas='z.png' needs 'z.json'", ("wang-tile", "z.png", *X)),
    ("atlas='odd.png': 'odd.json' does not", ("wang-tile", "odd.png", *X)),
    ("atlas='swap.png' does not have the", ("wang-tile", "swap.png", *X)),
    ("atlas='cut.png': 'cut.json' is damaged", ("wang-tile", "cut.png", *X)),
    ("size='0x9'", ("wang-tile", "a.png", "-o", "x.png", "--size", "0x9")),
    ("size=9999999x9999999 would", ("wang-tile", "a.png", "-o", "x.png", "--size", "9999999x9999999")),  # noqa: E501
    ("seed=-1", ("wang-tile", "a.png", "-o", "x.png", "--size", "9x9", "--seed", "-1")),
    ("output='a.png' would overwrite", ("wang-tile", "a.png", "-o", "a.png", "--size", "9x9")),
]  # fmt: skip


@pytest.mark.parametrize(("words", "arguments"), BAD, ids=[words for words, _ in BAD])
def test_bad_input_gets_one_sentence_and_code_2(
    run: Run, here: Path, words: str, arguments: tuple[str, ...]
) -> None:
    assert run("wang", "z.png", "-o", "a.png", *WANG).code == 0
    about = Path("a.json").read_text()
    for name in ("odd", "swap", "cut"):
        images.save(f"{name}.png", pixels("grey.png" if name == "swap" else "a.png"))
    Path("odd.json").write_text("[]")
    Path("swap.json").write_text(about)
    Path("cut.json").write_text(json.dumps(json.loads(about) | {"edges": []}))
    refused(run, here, words, *arguments)


@pytest.mark.parametrize("command", ["cyclic", "wang", "wang-tile"])
def test_help(run: Run, command: str) -> None:
    assert f"Usage: torchtex {command}" in run(command, "--help").out
