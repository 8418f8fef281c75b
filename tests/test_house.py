"""Rules of the house: which module may import which, what is public, docstrings that run."""

import ast
import doctest
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchtex
from torchtex.extras import EXTRAS

FOLDER = Path(torchtex.__file__).parent


def module_name(file: Path) -> str:
    """Dotted name below torchtex."""
    return ".".join(file.relative_to(FOLDER).with_suffix("").parts)


MODULES = sorted(
    module_name(file) for file in FOLDER.rglob("*.py") if not file.stem.startswith("__")
)

# a module may import only those of rows above its own; "cli" stands for all modules of the package
FLOORS = (
    ("codecs", "extras", "label_spaces", "volumes.formats", "meshes.mesh"),
    ("image", "wavelets", "neighborhoods", "quadratic"),
    (
        "data",
        "features",
        "matching",
        "sources",
        "cuts.laplace",
        "cuts.problems",
        "picks",
        "templates",
        "flow.fields",
        "video",
        "layers.chaos",
        "layers.resampling",
        "layers.tines",
        "layers.segment",
        "volumes.files",
        "meshes.atlas",
        "meshes.cubes",
        "meshes.formats",
        "meshes.placing",
        "meshes.subdivision",
        "meshes.surfaces",
        "render.raster",
        "render.views",
    ),
    (
        "bands",
        "energy",
        "metrics",
        "patches",
        "cuts.mincut",
        "cuts.poisson",
        "flow.warps",
        "flow.strokes",
        "flow.files",
        "flow.formulas",
        "layers.deform",
        "layers.whirls",
        "layers.plans",
        "volumes.slices",
        "volumes.histograms",
        "meshes.files",
        "meshes.shapes",
        "render.relief",
        "render.shadows",
    ),
    (
        "controls",
        "estep",
        "cuts.seams",
        "cuts.expansion",
        "qtp",
        "flow.fluids",
        "flow.vortices",
        "flow.pictures",
        "render.scene",
        "layers.elements",
        "layers.marbling",
        "layers.marbling_words",
        "volumes.carve",
    ),
    (
        "model",
        "cuts.paths",
        "render.pictures",
        "layers.stitch",
        "flow.words",
        "recipes.analogy",
        "recipes.region_maps",
    ),
    (
        "labels",
        "em",
        "recipes.labelings",
        "recipes.transfers",
        "recipes.detail",
        "recipes.levelling",
        "recipes.torn_windows",
        "recipes.block_seams",
    ),
    (
        "schedule",
        "starts",
        "carry",
        "inputs",
        "layouts",
        "recipes.montage",
        "recipes.analogy_costs",
        "recipes.correspondence",
        "recipes.hole_boxes",
        "recipes.hole_cut",
        "recipes.offsets",
        "recipes.strokes",
        "recipes.slice_models",
        "recipes.solid_places",
    ),
    (
        "result",
        "recipes.cms_canvas",
        "recipes.cms_search",
        "recipes.tile_parts",
        "recipes.patch_finders",
        "recipes.shares",
        "recipes.carried",
        "recipes.mended_canvas",
        "recipes.layer_pieces",
        "recipes.pieces",
        "recipes.planting",
        "recipes.slice_votes",
        "recipes.solid_parts",
        "recipes.skeleton_blocks",
    ),
    (
        "recipes.laying",
        "recipes.frame_squares",
        "recipes.frames",
        "recipes.homecoming",
        "recipes.piece_motion",
        "recipes.piece_search",
    ),
    (
        "synthesize",
        "recipes.solid_plan",
        "recipes.solid_result",
        "recipes.quilting",
        "recipes.cms",
        "recipes.completion",
        "recipes.mending",
        "recipes.moving",
    ),
    ("recipes.solid_run",),
    ("recipes",),
    ("recipes.design_parts", "recipes.skeletal_solid"),
    ("recipes.density", "recipes.design", "recipes.design_file"),
    ("recipes.design_stages",),
    ("cli",),
)
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names}

PUBLIC = {
    "Analogy", "Auto", "Blocks", "Checkpoint", "Chunked", "ClosedForm", "Clustered", "Descend",
    "Exact", "Gradients", "Grid", "Guide", "HalfStep", "LabelField", "Level", "Montage", "Motion",
    "Objective", "Pixels", "Progress", "RandomNeighborhoods", "Result", "Search",
    "SoftConstraint", "SourceField", "Stack", "Stage", "Stroke", "TextureEnergy", "TextureModel",
    "WangSet", "Wavelets", "animate", "blend", "brush", "carve", "cms", "complete", "cyclic",
    "data", "default_schedule", "deform", "density", "design", "designs", "edit", "em",
    "exact_search", "fast_search", "fill", "graphcut", "image", "image_analogies", "load_volume",
    "marble", "mesh_picture", "metrics", "mix", "normal_map", "parse_flow", "patchwise", "quilt",
    "read_mesh", "save_mesh", "save_volume", "segment", "skeletal_solid", "skeleton", "solid",
    "synthesize",
    "texture_model", "texture_picture", "transfer", "volume_picture", "wang_tiles", "wavelets",
}  # fmt: skip


def imports(source: str) -> Iterator[str]:
    """Dotted names of the torchtex modules that the source imports, anywhere in it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            if node.level:
                module = f"torchtex.{module}" if module else "torchtex"
            names = [f"{module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] == "torchtex":
                yield next(
                    (known for n in (3, 2) if (known := ".".join(parts[1:n])) in MODULES),
                    ".".join(parts[1:2]),
                )


def floor_of(name: str) -> int | None:
    """Floor of a module, or of the package that it is in when the package has one."""
    return FLOOR.get(name, FLOOR.get(name.split(".")[0]))


def test_imports_are_found_at_any_depth() -> None:
    source = "def f():\n    from torchtex.em import Fit\nimport torchtex.cli\nfrom . import data\n"
    assert set(imports(source)) == {"em", "cli", "data"}


@pytest.mark.parametrize("name", MODULES)
def test_no_module_imports_one_of_its_own_floor_or_above(name: str) -> None:
    own = floor_of(name)
    assert own is not None, f"give {name} its place in FLOORS"
    found = set(imports((FOLDER / f"{name.replace('.', '/')}.py").read_text(encoding="utf-8")))
    package = name.split(".")[0]
    if package != "cli":  # the top may ask the package for its version
        assert "" not in found, f"{name} imports the package, and so every floor"
    else:
        found = {other for other in found if other.split(".")[0] != "cli"}
    floors = {other: floor_of(other) for other in found if other}
    above = {other for other, floor in floors.items() if floor is None or floor >= own}
    assert not above, f"{name} is on floor {own} and imports {above}"


@pytest.mark.parametrize("name", [name for name in MODULES if "." not in name])
def test_no_module_of_the_core_imports_a_recipe_or_a_command(name: str) -> None:
    found = set(imports((FOLDER / f"{name}.py").read_text(encoding="utf-8")))
    assert not {other for other in found if other.split(".")[0] in ("recipes", "cli")}


def test_public_names_are_those_recorded_here() -> None:
    assert set(torchtex.__all__) - {"__version__"} == PUBLIC
    for name in PUBLIC:
        assert getattr(torchtex, name) is not None


def members(module: Any) -> Iterator[tuple[str, Any]]:
    for name, thing in vars(module).items():
        ours = getattr(thing, "__module__", None) == module.__name__
        if ours and not name.startswith("_") and (inspect.isclass(thing) or callable(thing)):
            yield name, thing


@pytest.mark.parametrize("name", MODULES)
def test_everything_public_says_what_it_is(name: str) -> None:
    module = importlib.import_module(f"torchtex.{name}")
    assert module.__doc__
    for label, thing in members(module):
        doc = inspect.getdoc(thing) or ""
        generated = inspect.isclass(thing) and doc.startswith(f"{label}(")  # by dataclass
        assert doc, f"{name}.{label} has no docstring"
        assert not generated, f"{name}.{label} has no docstring of its own"


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name: str) -> None:
    module = importlib.import_module(f"torchtex.{name}")
    names = {"torch": torch, "np": np, "torchtex": torchtex, **vars(module)}
    torch.manual_seed(0)
    for test in doctest.DocTestFinder(exclude_empty=True).find(module, name, globs=names):
        runner = doctest.DocTestRunner(
            optionflags=doctest.NORMALIZE_WHITESPACE | doctest.IGNORE_EXCEPTION_DETAIL
        )
        runner.run(test)
        assert runner.summarize(verbose=False).failed == 0, test.name


def test_extras_that_info_lists_are_those_of_the_package() -> None:
    text = (FOLDER.parent / "pyproject.toml").read_text(encoding="utf-8")
    section = text.split("[project.optional-dependencies]")[1].split("\n[")[0]
    found = {line.split(" = ")[0] for line in section.splitlines() if " = " in line}
    assert found - {"dev"} == set(EXTRAS)
