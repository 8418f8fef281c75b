"""The commands edit and blend: results, files that decide pixels, sentences for bad input."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Done, Run, pixels, refused

from torchtex import image as images
from torchtex.cli.marks import marks_in, written_mark
from torchtex.recipes.blend import blend
from torchtex.recipes.local_edit import Objects, edit
from torchtex.recipes.strokes import Stroke, brush
from torchtex.sources import SourceField

SIZE = (40, 48)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with pictures and marks, which is the current one."""
    monkeypatch.chdir(tmp_path)
    generator = torch.Generator().manual_seed(0)
    for name, size in (("base", SIZE), ("ref", (44, 50)), ("tiny", (12, 12))):
        image = torch.rand(3, size[0] // 2, size[1] // 2, generator=generator)
        images.save(f"{name}.png", images.resize(image, size).clamp(0, 1))
    images.save("grey.png", images.luminance(pixels("base.png"))[None])
    save_mark("mark.png", SIZE)
    save_mark("refmark.png", (44, 50))
    soft = 0.4 * brush(SIZE, [(14.0, 15.0)], 7.0) + 0.6 * brush(SIZE, [(14.0, 15.0)], 3.0)
    images.save("soft.png", soft[None].float())
    images.save("black.png", torch.zeros(1, *SIZE))
    Path("folder").mkdir()
    save_mark("folder/mark.png", SIZE)
    Path("text.png").write_text("no picture")
    Path("bad.json").write_text('[{"mask": ')
    return tmp_path


def save_mark(path: str, size: tuple[int, int]) -> None:
    """A dab, as a picture."""
    images.save(path, brush(size, [(14.0, 15.0)], 5.0)[None].float())


def written(content: Any) -> str:
    Path("strokes.json").write_text(json.dumps(content))
    return "strokes.json"


# --------------------------------------------------------------------------------- results


def test_edit_is_the_recipe_and_can_be_repeated(run: Run, here: Path) -> None:
    line = ("edit", "base.png", "--stroke", "mark.png:12,18", "--stroke", "mark.png:4,20:90:0.9")
    assert run(*line, "-o", "x.png", "--bits", 16, "--quiet") == Done(0, "x.png\n", "")
    dab = pixels("mark.png")[0]
    strokes = [Stroke(dab, (12, 18)), Stroke(dab, (4, 20), 90.0, 0.9)]
    wanted = edit(pixels("base.png"), strokes).texture
    assert torch.allclose(pixels("x.png"), wanted, atol=1e-5)
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))


def test_edit_writes_sources_seams_and_patches(run: Run, here: Path) -> None:
    done = run(
        "edit", "base.png", "--reference", "ref.png", "--stroke", "refmark.png:10,15:30",
        "--plain", "-o", "x.png", "--labels", "l.npz", "--seams", "s.png", "--patch-map", "p.png",
        "--report", "r.json", "--quiet",
    )  # fmt: skip
    assert done == Done(0, "x.png\n", "")
    shown = SourceField.load("l.npz").apply([pixels("base.png"), pixels("ref.png")])
    assert torch.allclose(pixels("x.png"), shown, atol=0.5 / 255 + 1e-6)
    assert pixels("s.png").shape == pixels("p.png").shape == (3, *SIZE)
    assert len(pixels("p.png").flatten(1).unique(dim=1).T) == 2  # base and stroke
    about = json.loads(Path("r.json").read_text())
    assert about["command"] == "edit"
    assert set(about["files"]) == {"base.png", "ref.png", "refmark.png"}
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    assert run("apply", "l.npz", "base.png", "ref.png", "-o", "z.png").code == 0
    assert torch.equal(pixels("z.png"), pixels("x.png"))


def test_strokes_of_a_file_are_drawn_and_loaded(run: Run, here: Path) -> None:
    strokes = [
        {"mask": "mark.png", "offset": [12, 18]},
        {"path": [[10, 10], [14, 15]], "radius": 3, "offset": [3, 20], "rotation": 20},
        {"circles": [[10, 10, 3], [12, 12, 4.5]], "offset": [20, 2], "scale": 1.2},
        {"polygon": [[5, 5], [5, 15], [15, 10]], "offset": [1, 25], "mirror": True},
    ]
    (here / "folder" / "strokes.json").write_text(json.dumps(strokes))
    line = ("edit", "base.png", "--strokes", "folder/strokes.json", "--no-objects", "--band", 6)
    assert run(*line, "-o", "x.png", "--report", "r.json", "--quiet").code == 0
    about = json.loads(Path("r.json").read_text())
    assert set(about["files"]) == {"base.png", "folder/strokes.json", "folder/mark.png"}
    assert about["settings"]["objects"] is None
    assert about["patches"] == 5
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    Path("folder/mark.png").write_bytes(Path("black.png").read_bytes())
    done = run("repeat", "x.png", "-o", "y.png", "--quiet")
    assert done.code == 2
    assert "changed" in done.err


def test_grey_paint_is_soft_and_grey_pictures_stay_grey(run: Run, here: Path) -> None:
    assert run("edit", "grey.png", "--stroke", "soft.png:12,18", "-o", "x.png", "--quiet").code == 0
    assert pixels("x.png").shape == (1, *SIZE)
    soft = Stroke(pixels("soft.png")[0], (12, 18))
    wanted = edit(pixels("grey.png"), [soft]).texture
    assert torch.allclose(pixels("x.png"), wanted, atol=0.5 / 255 + 1e-6)
    line = ("edit", "base.png", "--reference", "grey.png", "--stroke", "mark.png:12,18")
    assert run(*line, "-o", "y.png", "--quiet").code == 0
    assert pixels("y.png").shape == (3, *SIZE)


def test_options_reach_the_recipe(run: Run, here: Path) -> None:
    line = ("edit", "base.png", "--stroke", "mark.png:12,18", "-o", "x.png", "--quiet")
    assert run(*line, "--k1", 0.9, "--k2", 0.1, "--data-cost", 50, "--band", 3).code == 0
    stroke = Stroke(pixels("mark.png")[0], (12, 18))
    wanted = edit(pixels("base.png"), [stroke], k1=0.9, k2=0.1, data_cost=50.0, band=3)
    assert torch.allclose(pixels("x.png"), wanted.texture, atol=0.5 / 255 + 1e-6)
    assert wanted.settings["objects"]["whole"] == Objects().whole


def test_blend_is_the_recipe_and_can_be_repeated(run: Run, here: Path) -> None:
    line = ("blend", "base.png", "ref.png", "--mask", "refmark.png", "--offset", "-3,6")
    done = run(*line, "-o", "x.png", "--bits", 16, "--labels", "l.npz", "--seams", "s.png")
    assert done.code == 0, done.err
    mask = pixels("refmark.png")[0] > 0.5
    wanted = blend(pixels("base.png"), pixels("ref.png"), mask, (-3, 6))
    assert torch.allclose(pixels("x.png"), wanted.image.clamp(0, 1), atol=1e-5)
    shown = SourceField.load("l.npz").apply([pixels("base.png"), pixels("ref.png")])
    assert torch.equal(shown, wanted.pasted)
    assert run("repeat", "x.png", "-o", "y.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    assert run(*line, "-o", "z.png", "--plain", "--quiet").code == 0
    assert torch.equal(pixels("z.png"), wanted.pasted)
    assert run(*line, "-o", "m.png", "--mixed", "--quiet").code == 0
    assert not torch.equal(pixels("m.png"), pixels("z.png"))
    line = ("blend", "base.png", "tiny.png", "--offset=35,-4", "-o", "w.png", "--quiet")
    assert run(*line).code == 0  # without a mask the whole of it, as far as it fits


# ------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "stroke: none given"),
        (("--stroke", "mark.png"), "stroke='mark.png' is not MASK:ROW,COL"),
        (("--stroke", "mark.png:1.5,2"), "is not MASK:ROW,COL"),
        (("--stroke", "mark.png:1,2:x"), "is not MASK:ROW,COL"),
        (("--stroke", "mark.png:1,2:0:0"), "scale=0.0 must be above 0"),
        (("--stroke", "mark.png:1,2:0:-1"), "scale=-1.0 must be above 0"),
        (("--stroke", "none.png:1,2"), "none.png"),
        (("--stroke", "text.png:1,2"), "none of the pictures"),
        (("--stroke", "black.png:1,2"), "mask is empty"),
        (("--stroke", "refmark.png:1,2"), "mask='refmark.png' has 44x50 pixels and the reference"),
        (("--stroke", "mark.png:1,2", "--reference", "tiny.png"), "reference 12x12"),
        (("--stroke", "mark.png:1,2", "--reference", "nothing.png"), "nothing.png"),
        (("--stroke", "mark.png:99,0"), "stroke 1: offset=(99, 0) leaves nothing"),
        (("--stroke", "mark.png:1,2", "--stroke", "mark.png:0,-200"), "stroke 2: offset"),
        (("--stroke", "mark.png:1,2", "--k1", "-1"), "k1=-1.0"),
        (("--stroke", "mark.png:1,2", "--k2", "nan"), "k2=nan"),
        (("--stroke", "mark.png:1,2", "--data-cost", "0"), "data_cost=0.0"),
        (("--stroke", "mark.png:1,2", "--band", "0"), "band=0"),
        (("--stroke", "mark.png:1,2", "--bits", "9"), "bits=9"),
        (("--stroke", "mark.png:1,2", "--seams", "x.txt"), "seams="),
        (("--strokes", "bad.json"), "is not JSON"),
        (("--strokes", "missing.json"), "cannot be read"),
        (("--strokes", "text.png"), "is not JSON"),
    ],
)
def test_edit_refuses_in_one_sentence(
    run: Run, here: Path, arguments: tuple[str, ...], words: str
) -> None:
    line = ("edit", "base.png", *arguments, "-o", "x.png", "--quiet")
    refused(run, here, words, *line)


GOOD = {"path": [[10, 10]], "radius": 4, "offset": [12, 18]}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([], "holds no strokes"),
        ({}, "is no list of strokes"),
        ([3], "is no list of strokes"),
        ([GOOD | {"rotaton": 3}], "'rotaton' is unknown; did you mean rotation"),
        ([{"offset": [1, 2]}], "stroke 1 has no mark; give one of mask, path"),
        ([GOOD | {"mask": "mark.png"}], "has mask and path"),
        ([{"path": [[1, 2]], "offset": [1, 2]}], "a path needs one"),
        ([{"circles": [[1, 2, 3]], "radius": 3, "offset": [1, 2]}], "a radius goes with a path"),
        ([{"path": [[10, 10]], "radius": 4}], "offset has None; it must be [row, column]"),
        ([GOOD | {"offset": [1.5, 2]}], "must be whole numbers"),
        ([GOOD | {"offset": [1, True]}], "offset has [1, True]"),
        ([GOOD | {"path": []}], "path must be a list of points, not empty"),
        ([GOOD | {"path": [[1, 2, 3]]}], "path has [1, 2, 3]"),
        ([GOOD | {"path": [[-90, 2]]}], "path paints no pixel of the 40 x 48 reference"),
        ([GOOD | {"radius": 0}], "radius=0.0 must be above 0"),
        ([GOOD | {"radius": "wide"}], "radius has 'wide'; it must be a number"),
        ([GOOD | {"scale": 0}], "scale=0.0 must be above 0"),
        ([GOOD | {"rotation": None}], "rotation has None"),
        ([GOOD | {"mirror": 1}], "mirror=1 must be true or false"),
        ([{"circles": [[1, 2]], "offset": [1, 2]}], "circles has [1, 2]"),
        ([{"polygon": [[1, 2], [3, 4]], "offset": [1, 2]}], "polygon has 2 points"),
        ([{"mask": 7, "offset": [1, 2]}], "mask=7 must be the name of a file"),
        ([{"mask": "gone.png", "offset": [1, 2]}], "gone.png"),
        ([{"mask": "refmark.png", "offset": [1, 2]}], "has 44x50 pixels"),
        ([GOOD, GOOD | {"offset": [90, 0]}], "stroke 2: offset=(90, 0)"),
    ],
)
def test_a_file_of_strokes_is_refused_in_one_sentence(
    run: Run, here: Path, content: Any, words: str
) -> None:
    name = written(content)
    line = ("edit", "base.png", "--strokes", name, "-o", "x.png", "--quiet")
    refused(run, here, words, *line)


def test_outputs_must_not_be_inputs(run: Run, here: Path) -> None:
    line = ("edit", "base.png", "--stroke", "mark.png:1,2", "--quiet")
    for extra in (("-o", "mark.png"), ("-o", "base.png"), ("-o", "x.png", "--seams", "mark.png")):
        done = run(*line, *extra)
        assert done.code == 2
        assert "overwrite an input" in done.err


def test_without_a_solver_the_extra_is_named(
    run: Run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "maxflow", None)
    monkeypatch.setitem(sys.modules, "ortools.graph.python.max_flow", None)
    done = run("edit", "base.png", "--stroke", "mark.png:1,2", "-o", "x.png", "--quiet")
    assert done.code == 2
    assert "torchtex[graphcut]" in done.err
    assert not Path("x.png").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("ref.png", "--offset", "3"), "offset='3' is not ROW,COL"),
        (("ref.png", "--offset", "99,0"), "puts the whole mask outside"),
        (("ref.png", "--mask", "mark.png"), "make them the same size"),
        (("base.png", "--mask", "black.png"), "is empty"),
        (("ref.png", "--boundary", "periodic"), "boundary='periodic' is unknown"),
        (("ref.png", "--boundary", "dirichlet"), "border"),
        (("gone.png",), "gone.png"),
    ],
)
def test_blend_refuses_in_one_sentence(
    run: Run, here: Path, arguments: tuple[str, ...], words: str
) -> None:
    done = run("blend", "base.png", *arguments, "-o", "x.png", "--quiet")
    assert done.code == 2
    assert words in done.err
    assert done.err.count("\n") == 1
    assert not Path("x.png").exists()


# --------------------------------------------------------------------------------- written


def test_marks_are_read_as_written(here: Path) -> None:
    mark_of = written_mark("a:1,2/b.png:-3,+4:-12.5:2e-1")
    assert (mark_of.mask, mark_of.offset) == ("a:1,2/b.png", (-3, 4))
    assert (mark_of.rotation, mark_of.scale) == (-12.5, 0.2)
    (found,) = marks_in(Path(written([GOOD | {"mirror": True}])))
    assert (found.shape, found.points, found.radius) == ("path", ((10.0, 10.0),), 4.0)
    assert found.mirror
