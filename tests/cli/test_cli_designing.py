"""The commands deform, segment, complete and design: results, files, sentences for bad input."""

import json
from pathlib import Path

import pytest
import torch
from conftest import Done, Run, pixels, refused

from torchtex import image as images
from torchtex.cli.layers import load_scribbles, parse_range
from torchtex.layers.deform import Deformation, deform
from torchtex.layers.segment import segment
from torchtex.recipes.completion import complete
from torchtex.sources import SourceField

SIZE = (48, 52)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with pictures and masks, which is the current one."""
    monkeypatch.chdir(tmp_path)
    generator = torch.Generator().manual_seed(0)
    row, col = torch.arange(SIZE[0])[:, None], torch.arange(SIZE[1])
    dots = torch.full((3, *SIZE), 0.2)
    for y, x, radius in ((12, 14, 8), (30, 36, 9), (38, 10, 6)):
        dots[:, (row - y) ** 2 + (col - x) ** 2 <= radius**2] = 0.8
    dots += 0.1 * torch.rand(dots.shape, generator=generator)
    images.save("dots.png", dots)
    images.save("grey.png", dots[:1])
    images.save("noise.png", torch.rand(3, *SIZE, generator=generator))
    images.save("flat.png", torch.full((3, *SIZE), 0.5))
    images.save("glass.png", torch.cat([dots, (col > 9).expand(1, *SIZE).float()]))
    hole = torch.zeros(1, *SIZE)
    hole[:, 16:30, 20:36] = 1
    images.save("hole.png", hole)
    images.save("black.png", torch.zeros(1, *SIZE))
    images.save("white.png", torch.ones(1, *SIZE))
    images.save("small.png", torch.ones(1, 9, 9))
    marks = torch.zeros(3, *SIZE)
    marks[0, 10:14, 12:16] = 1
    marks[2, 2:5] = 1
    images.save("marks.png", marks)
    Path("text.png").write_text("no picture")
    return tmp_path


def repeated(run: Run, picture: str) -> None:
    """Asserts that `torchtex repeat` gives equal pixels."""
    assert run("repeat", picture, "-o", "again.png", "--quiet").code == 0
    assert torch.equal(pixels(picture), pixels("again.png"))


# --------------------------------------------------------------------------------- results


def test_deform_is_the_function_and_can_be_repeated(run: Run, here: Path) -> None:
    line = ("deform", "dots.png", "--rotate", 30, "--scale", 1.2, "--rows", -3, "--mirror", 1)
    assert run(*line, "-o", "x.png", "--labels", "l.npz") == Done(0, "x.png\n", "")
    wanted = deform(pixels("dots.png"), Deformation((-3.0, 0.0), 30.0, 1.2, mirror=True))
    loaded = images.load("x.png")
    assert torch.allclose(loaded.image, wanted.texture, atol=0.51 / 255)
    assert loaded.mask is not None
    assert torch.equal(loaded.mask, wanted.mask)
    shown = SourceField.load("l.npz").apply(pixels("dots.png"))
    assert torch.allclose(shown, loaded.image, atol=0.51 / 255)
    repeated(run, "x.png")
    assert run(*line, "-o", "x.jpg", "--quiet").code == 0
    assert pixels("x.jpg").shape == (3, *SIZE)


def test_deform_draws_from_ranges_by_seed(run: Run, here: Path) -> None:
    line = ("deform", "dots.png", "--rotate=-40:40", "--cols", "-5:5", "--flip", 0.5, "--quiet")
    for seed in (1, 2):
        assert run(*line, "--seed", seed, "-o", f"{seed}.png", "--report", f"{seed}.json").code == 0
    drawn = [json.loads(Path(f"{n}.json").read_text())["settings"]["deformation"] for n in (1, 2)]
    assert drawn[0] != drawn[1]
    assert all(abs(one["rotate"]) <= 40 for one in drawn)
    repeated(run, "1.png")
    assert run(*line, "--complete", "-o", "c.png").code == 0
    assert images.load("c.png").mask is None


def test_segment_writes_a_map_its_layers_and_their_children(run: Run, here: Path) -> None:
    line = ("segment", "dots.png", "--layers", 2, "--quiet")
    done = run(*line, "-o", "x.png", "--pictures", "l.png", "--patch-map", "c.png", "--report",
               "r.json")  # fmt: skip
    assert done == Done(0, "x.png\n", "")
    made = segment(pixels("dots.png"), 2)
    assert torch.equal(load_scribbles("x.png", SIZE), made.labels)
    for layer in range(2):
        loaded = images.load(f"l_{layer + 1}.png")
        assert loaded.mask is not None
        assert torch.equal(loaded.mask, made.mask(layer))
        assert torch.equal(loaded.image, pixels("dots.png"))
    about = json.loads(Path("r.json").read_text())["settings"]["layers"]
    assert [one["pixels"] for one in about] == [int(made.mask(n).sum()) for n in range(2)]
    repeated(run, "x.png")
    # the map can be scribbled on, and given back
    assert run("segment", "dots.png", "-o", "y.png", "--scribbles", "x.png", "--quiet").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))


def test_scribbles_and_masks_name_layers(run: Run, here: Path) -> None:
    line = ("segment", "dots.png", "-o", "x.png", "--quiet")
    assert run(*line, "--scribbles", "marks.png", "--method", "meanshift").code == 0
    labels = load_scribbles("x.png", SIZE)
    assert int(labels[30, 36]) == int(labels[12, 14]) != int(labels[24, 20])
    assert run(*line, "--mask", "hole.png").code == 0
    assert torch.equal(load_scribbles("x.png", SIZE) == 1, pixels("hole.png")[0] > 0.5)
    repeated(run, "x.png")


def test_complete_is_the_recipe_and_can_be_repeated(run: Run, here: Path) -> None:
    line = ("complete", "dots.png", "--mask", "hole.png", "--patch", 14, "--quiet")
    assert run(*line, "-o", "x.png", "--bits", 16) == Done(0, "x.png\n", "")
    hole = pixels("hole.png")[0] > 0.5
    wanted = complete(pixels("dots.png"), hole, patch=14)
    assert torch.allclose(pixels("x.png"), wanted.texture, atol=1e-5)
    repeated(run, "x.png")
    done = run(
        *line, "--source", "noise.png", "--source", "grey.png", "--plain", "--order",
        "confidence", "--search", "qtp", "--detail", 1.5, "-o", "y.png", "--labels", "l.npz",
        "--seams", "s.png", "--patch-map", "p.png", "--report", "r.json",
    )  # fmt: skip
    assert done.code == 0
    grey = pixels("grey.png").expand(3, -1, -1)
    field = SourceField.load("l.npz")
    shown = field.apply([pixels("dots.png"), pixels("noise.png"), grey])
    assert torch.allclose(pixels("y.png"), shown, atol=0.51 / 255)
    settings = json.loads(Path("r.json").read_text())["settings"]
    assert (settings["order"], settings["detail"]) == ("confidence", 1.5)
    assert pixels("s.png").shape == pixels("p.png").shape == (3, *SIZE)
    repeated(run, "y.png")


DESIGN = ("design", "dots.png", "--size", "40x50", "--layers", 2, "--patch", 12, "--quiet")


def test_design_makes_one_or_several_that_can_be_repeated(run: Run, here: Path) -> None:
    done = run(*DESIGN, "-o", "x.png", "--labels", "l.npz", "--report", "r.json", "--seed", 4)
    assert done == Done(0, "x.png\n", "")
    shown = SourceField.load("l.npz").apply(pixels("dots.png"))
    assert torch.allclose(pixels("x.png"), shown, atol=0.51 / 255)
    repeated(run, "x.png")
    done = run(*DESIGN, "-o", "y.png", "--count", 2, "--seed", 3, "--workers", 1, "--labels",
               "m.npz", "--seams", "s.png")  # fmt: skip
    assert done == Done(0, "y_1.png\ny_2.png\n", "")
    assert torch.equal(pixels("y_2.png"), pixels("x.png"))
    assert not torch.equal(pixels("y_1.png"), pixels("x.png"))
    assert {"m_1.npz", "m_2.npz", "s_1.png"} <= {path.name for path in here.iterdir()}
    repeated(run, "y_2.png")


def test_design_takes_layers_plans_and_ranges(run: Run, here: Path) -> None:
    options = ("--scribbles", "marks.png", "--enlarge", "layers", "--cyclic", 8, "--chaos", "tent",
               "--rotate=-20:20", "--mirror", 0.5, "--search", "qtp")  # fmt: skip
    assert run(*DESIGN, *options[2:], "-o", "x.png").code == 0
    assert pixels("x.png").shape == (3, 40, 50)
    assert run(*DESIGN, *options[:8], "-o", "z.png").code == 0
    repeated(run, "x.png")
    count = len(segment(pixels("dots.png"), 2).children.unique())
    Path("plan.json").write_text(json.dumps([[{"kind": "scale", "amount": 1.1}]] * count))
    line = (*DESIGN, "--textures", 1, "--plan", "plan.json")
    assert run(*line, "-o", "y.png").code == 0
    repeated(run, "y.png")


@pytest.mark.parametrize("options", [("--textures", 2), ("--textures", 1), ("--enlarge", "layers")])
def test_a_report_is_a_plan_that_can_be_edited(
    run: Run, here: Path, options: tuple[object, ...]
) -> None:
    line = (*DESIGN, "--seed", 2, *options)
    assert run(*line, "-o", "x.png", "--report", "r.json").code == 0
    assert run(*line, "-o", "y.png", "--plan", "r.json").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    report = json.loads(Path("r.json").read_text())
    held = json.loads(images.read_metadata("x.png")["torchtex"])["settings"]
    assert not {"plan", "plans"} & set(held)  # which are long
    plans = report["settings"].get("plans") or [report["settings"]["plan"]]
    assert len(plans) == (2 if options[1] == 2 else 1)
    for layer in plans[0]:
        layer[:] = [{"kind": "mirror", "direction": "up-down"}]
    Path("r.json").write_text(json.dumps(report))
    assert run(*line, "-o", "z.png", "--plan", "r.json").code == 0
    assert not torch.equal(pixels("x.png"), pixels("z.png"))
    repeated(run, "z.png")


def test_recipe_files_keep_plans_and_take_them(run: Run, here: Path) -> None:
    stage = "exemplars: [dots.png]\nstages:\n - layers: {size: [40, 44], layers: 2, patch: 12}\n"
    Path("a.yaml").write_text(stage)
    line = ("design", "--recipe", "a.yaml", "--cache", "kept", "--quiet")
    assert run(*line, "-o", "x.png", "--report", "r.json").code == 0
    plan = json.loads(Path("r.json").read_text())["settings"]["plan"]
    assert run(*line, "-o", "x.png", "--report", "s.json").code == 0  # from the cache
    assert json.loads(Path("s.json").read_text())["settings"]["plan"] == plan
    Path("a.yaml").write_text(stage.replace("12}", "12, plan: r.json}"))
    assert run(*line, "-o", "y.png").code == 0
    assert torch.equal(pixels("x.png"), pixels("y.png"))
    Path("r.json").write_text(json.dumps({"plan": [[], *plan[1:]]}))
    assert run(*line, "-o", "z.png").code == 0
    assert not torch.equal(pixels("x.png"), pixels("z.png"))
    repeated(run, "z.png")


STAGES = """
exemplars: [dots.png, noise.png]
seed: 3
stages:
  - deform: {count: 1, rotate: [-20, 20]}
  - edit: {base: 0, reference: 2, mask: hole.png, offset: [2, 3]}
  - enlarge: {count: 1, size: [40, 44], by: graphcut, cyclic: 8}
  - layers: {count: 2, size: [40, 44], layers: 2, patch: 12}
"""


def test_a_recipe_file_goes_on_from_what_it_kept(run: Run, here: Path) -> None:
    Path("a.yaml").write_text(STAGES)
    line = ("design", "--recipe", "a.yaml", "--cache", "kept", "--quiet")
    assert run(*line, "-o", "x.png") == Done(0, "x_1.png\nx_2.png\nx_3.png\n", "")
    assert stages("x_1.png") == [True] * 4
    assert run(*line, "-o", "y.png").code == 0
    assert stages("y_1.png") == [False] * 4
    Path("a.yaml").write_text(STAGES.replace("layers: 2,", "layers: 3,"))
    assert run(*line, "-o", "z.png").code == 0
    assert stages("z_1.png") == [False, False, False, True]
    assert torch.equal(pixels("z_1.png"), pixels("x_1.png"))
    assert not torch.equal(pixels("z_2.png"), pixels("x_2.png"))
    Path("a.yaml").write_text(STAGES.replace("[2, 3]", "[4, 3]"))
    assert run(*line, "-o", "w.png").code == 0
    assert stages("w_1.png") == [False, True, True, True]
    for file in Path("kept").iterdir():  # torn files are made again
        file.write_bytes(b"torn")
    assert run(*line, "-o", "v.png").code == 0
    assert stages("v_1.png") == [True] * 4
    assert torch.equal(pixels("v_3.png"), pixels("w_3.png"))
    repeated(run, "v_3.png")
    Path("a.json").write_text(json.dumps({"exemplars": ["dots.png"], "stages": [
        {"layers": {"size": [40, 44], "layers": 2, "patch": 12}}]}, indent=1))  # fmt: skip
    assert run("design", "--recipe", "a.json", "-o", "j.png", "--quiet") == Done(0, "j.png\n", "")


def test_turns_are_the_default_of_both_stages(run: Run, here: Path) -> None:
    text = "exemplars: [dots.png]\nstages:\n - %s: {size: [64, 72], %s turns: %s}\n"
    for stage, extra in (("enlarge", ""), ("layers", "layers: 2, patch: 12,")):
        made = {}
        for turns in ("true", "false", None):
            line = text % (stage, extra, turns)
            Path("a.yaml").write_text(line.replace(" turns: None", ""))
            assert run("design", "--recipe", "a.yaml", "-o", "x.png", "--quiet").code == 0
            made[turns] = pixels("x.png")
        assert torch.equal(made[None], made["true"])


def stages(picture: str) -> list[bool]:
    about = json.loads(images.read_metadata(picture)["torchtex"])
    return [stage["run"] for stage in about["stages"]]


# ------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("rotate='round' must be a number", ("deform", "dots.png", "--rotate", "round")),
        ("scale=0.05:0.05 must lie in 0.1..10", ("deform", "dots.png", "--scale", 0.05)),
        ("scale=1.0:20.0", ("deform", "dots.png", "--scale", "1:20")),
        ("rows=5.0:2.0", ("deform", "dots.png", "--rows", "5:2")),
        ("mirror=2.0 must be a probability", ("deform", "dots.png", "--mirror", 2)),
        ("seed=-1", ("deform", "dots.png", "--seed", -1)),
        ("is transparent in places", ("deform", "glass.png", "--complete")),
        ("no such file", ("deform", "none.png")),
        ("seen after translate=(500.0, 0.0)", ("deform", "dots.png", "--rows", 500)),
        ("seen after translate=(0.0, 60.0)", ("deform", "dots.png", "--cols", 60, "--complete")),
        ("method='magic'", ("segment", "dots.png", "--method", "magic")),
        ("layers=1 must lie in 2..64", ("segment", "dots.png", "--layers", 1)),
        ("layers=3: only", ("segment", "flat.png")),
        ("mask of layer 1", ("segment", "dots.png", "--mask", "hole.png", "--mask", "white.png")),
        ("one layer only", ("segment", "dots.png", "--mask", "white.png")),
        ("give one of them",
         ("segment", "dots.png", "--mask", "hole.png", "--scribbles", "marks.png")),
        ("scribbles='small.png' has 9 x 9", ("segment", "dots.png", "--scribbles", "small.png")),
        ("colours; draw each layer", ("segment", "dots.png", "--scribbles", "noise.png")),
        ("scribbles name 0 layer", ("segment", "dots.png", "--scribbles", "black.png")),
        ("pictures='l_1.gif' must end", ("segment", "dots.png", "--pictures", "l.gif")),
        ("mask='black.png' is empty", ("complete", "dots.png", "--mask", "black.png")),
        ("there is no source", ("complete", "dots.png", "--mask", "white.png")),
        ("mask='small.png'", ("complete", "dots.png", "--mask", "small.png")),
        ("patch=40 fits nowhere", ("complete", "dots.png", "--mask", "hole.png", "--patch", 40)),
        ("patch=12 is larger than a source",
         ("complete", "dots.png", "--mask", "hole.png", "--patch", 12, "--source", "small.png")),
        ("patch=200 is larger than the shorter side of the image, 48 pixels",
         ("complete", "dots.png", "--mask", "hole.png", "--patch", 200)),
        ("order='zigzag'", ("complete", "dots.png", "--mask", "hole.png", "--order", "zigzag")),
        ("search='far'", ("complete", "dots.png", "--mask", "hole.png", "--search", "far")),
        ("solver='luck'", ("complete", "dots.png", "--mask", "hole.png", "--solver", "luck")),
        ("exemplar: none given", ("design",)),
        ("layers=1", ("design", "dots.png", "--layers", 1)),
        ("layers=3: only", ("design", "flat.png")),
        ("size='big'", ("design", "dots.png", "--size", "big")),
        ("keep_partial is for one design and count=2",
         ("design", "dots.png", "--count", 2, "--keep-partial")),
        ("count=0", ("design", "dots.png", "--count", 0)),
        ("enlarge='zoom'", ("design", "dots.png", "--enlarge", "zoom")),
        ("map='cat'", ("design", "dots.png", "--chaos", "cat")),
        ("textures=0", ("design", "dots.png", "--textures", 0)),
        ("cyclic_overlap=1", ("design", "dots.png", "--cyclic", 1)),
        ("give one each", ("design", "dots.png", "noise.png", "--scribbles", "marks.png")),
        ("is transparent in places", ("design", "glass.png")),
        ("cache and only are for --recipe", ("design", "dots.png", "--cache", "c")),
        ("plan: 1 given and textures=3; give all", ("design", "dots.png", "--plan", "plan.json")),
        ("plan='none.json' holds no plan", ("design", "dots.png", "--plan", "none.json")),
        ("plan='text.png' is no json", ("design", "dots.png", "--plan", "text.png")),
        ("layer 0, operation 0: kind='bend'", ("design", "dots.png", "--plan", "bad.json")),
        ("decided by --recipe", ("design", "--recipe", "a.yaml", "--layers", 4)),
        ("seams does not go with --recipe", ("design", "--recipe", "a.yaml", "--seams", "s.png")),
        ("which names exemplars", ("design", "dots.png", "--recipe", "a.yaml")),
        ("recipe='none.yaml': there is no such file", ("design", "--recipe", "none.yaml")),
        ("only=9 must lie in 1..3", ("design", "--recipe", "a.yaml", "--only", 9)),
        ("cache='dots.png' is no folder", ("design", "--recipe", "a.yaml", "--cache", "dots.png")),
    ],
)  # fmt: skip
def test_bad_input_is_one_sentence(
    words: str, line: tuple[object, ...], run: Run, here: Path
) -> None:
    Path("plan.json").write_text("[[]]")
    Path("none.json").write_text('{"settings": {}}')
    Path("bad.json").write_text('[[{"kind": "bend"}]]')
    Path("a.yaml").write_text(STAGES)
    refused(run, here, words, *line, "-o", "x.png", "--quiet")


@pytest.mark.parametrize(
    ("words", "old", "new"),
    [
        ("line 5: stage 'bend' is unknown; choose deform", "- deform:", "- bend:"),
        ("line 2: exemplar='gone.png': there is no such file", "noise.png", "gone.png"),
        ("line 6: mask='gone.png': there is no such file", "hole.png", "gone.png"),
        ("line 6: offset=[2] must be two whole numbers", "[2, 3]", "[2]"),
        ("line 5: rotate=[20, -20] must be a number, or two", "[-20, 20]", "[20, -20]"),
        ("line 7: by='zoom' is unknown", "graphcut", "zoom"),
        ("line 8: stage layers has no 'colour'", "patch: 12", "colour: 12"),
        ("line 8: layers=[] must be a whole number", "layers: 2,", "layers: [],"),
        ("line 3: seed='x' must be a whole number", "seed: 3", "seed: x"),
        ("line 3: seed=-3", "seed: 3", "seed: -3"),
        ("line 3: recipe has no 'sed'", "seed: 3", "sed: 3"),
        ("line 6: stage edit needs a mask or a path", "mask: hole.png, ", ""),
        ("line 6, stage edit: reference=9", "reference: 2", "reference: 9"),
        ("line 6, stage edit: mask", "hole.png", "black.png"),
        ("line 8, stage layers: layers=1", "layers: 2,", "layers: 1,"),
        ("line 5, stage deform: scale=20", "rotate: [-20, 20]", "scale: 20"),
        ("line 6: stage deform comes too late or twice", "edit: {base: 0, reference: 2, mask: "
         "hole.png, offset: [2, 3]}", "deform: {}"),
        ("line 7: cyclic=-5 must lie in 2..40, the shorter", "cyclic: 8", "cyclic: -5"),
        ("line 7: cyclic=41", "cyclic: 8", "cyclic: 41"),
        ("line 8: count=0 must lie in 1..10000", "{count: 2", "{count: 0"),
        ("line 7: size=[40, 0] must be", "[40, 44], by", "[40, 0], by"),
        ("line 8: plan='r.txt' is no JSON", "patch: 12", "plan: r.txt"),
        ("line 8, stage layers: plan has 1 list", "patch: 12", "plan: p.json"),
        ("line 2: exemplars must be a list", "[dots.png, noise.png]", "dots.png"),
        ("line 5:", "{count: 1,", "{count: 1"),
        ("exemplars is missing", "exemplars: [dots.png, noise.png]", ""),
    ],
)  # fmt: skip
def test_a_bad_recipe_names_the_line(words: str, old: str, new: str, run: Run, here: Path) -> None:
    assert old in STAGES
    Path("r.txt").write_text("words")
    Path("p.json").write_text("[[]]")
    Path("a.yaml").write_text(STAGES.replace(old, new))
    refused(run, here, words, "design", "--recipe", "a.yaml", "-o", "x.png", "--quiet")


def test_recipes_that_make_nothing_are_refused(run: Run, here: Path) -> None:
    for text, words in (
        ("", "is empty"),
        ("exemplars: [dots.png]\nstages: [deform: {}]", "no stage makes a texture"),
        ("exemplars: [dots.png]\nstages: []", "stages must be a list"),
        ("just words", "recipe must be names"),
        ("exemplars: [dots.png]\nstages: [[1]]", "a stage is one name"),
    ):
        Path("b.yaml").write_text(text)
        refused(run, here, words, "design", "--recipe", "b.yaml", "-o", "x.png", "--quiet")


def test_ranges_are_read() -> None:
    assert parse_range("3", "a") == (3.0, 3.0)
    assert parse_range("-.5:+2.25", "a") == (-0.5, 2.25)
    with pytest.raises(ValueError, match="a='1:2:3'"):
        parse_range("1:2:3", "a")
