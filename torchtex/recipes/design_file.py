"""Recipe files of designs: exemplars, a seed and stages, in YAML or JSON, checked line by line.

    exemplars: [flowers.png]
    seed: 7
    stages:
      - deform: {count: 3, rotate: [-30, 30], mirror: 0.5}
      - edit: {base: 0, reference: 1, path: [[40, 30], [52, 36]], radius: 12, offset: [-20, 35]}
      - enlarge: {count: 2, size: [256, 256], by: wavelet}
      - layers: {count: 2, size: [256, 256]}

The stages are those of the paper: whole exemplars are deformed; elements of one deformed texture
are put into another; large textures are made of them; and large textures with deformed layers.
Each may be left out, `edit` may occur several times.

Source: Shen et al. 2010, Texture design by energy optimization, figure 2.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchtex.extras import needed
from torchtex.image import read_bytes
from torchtex.layers.plans import Plan

Settings = Mapping[str, Any]
_NUMBERS = (int, float)
_SPAN = "a number, or two, the lesser first"
KNOWN: Mapping[str, Mapping[str, str]] = {
    "deform": {
        "count": "whole", "rows": "span", "cols": "span", "rotate": "span", "scale": "span",
        "mirror": "number", "flip": "number",
    },
    "edit": {
        "base": "whole", "reference": "whole", "mask": "file", "path": "points",
        "radius": "number", "offset": "pair", "rotation": "number", "scale": "number",
        "mirror": "flag",
    },
    "enlarge": {
        "count": "whole", "size": "pair", "by": "enlarge", "cyclic": "whole", "poisson": "flag",
        "turns": "flag",
    },
    "layers": {
        "count": "whole", "size": "pair", "layers": "whole", "method": "method",
        "combined": "whole", "iterations": "whole", "map": "map", "patch": "whole",
        "search": "search", "order": "order", "cyclic": "whole", "poisson": "flag", "plan": "plan",
        "variety": "number", "turns": "flag",
    },
}  # fmt: skip
"""Stages, and what may be set in each."""
SIZE = (256, 256)
"""Rows and columns of large textures, unless set."""
_CHOICES = {
    "enlarge": ("graphcut", "wavelet"), "method": ("graph", "meanshift"),
    "map": ("logistic", "tent", "henon"), "search": ("exhaustive", "fft", "qtp"),
    "order": ("scan", "confidence"),
}  # fmt: skip
_ORDER = tuple(KNOWN)


@dataclass(frozen=True)
class StageEntry:
    """One stage of a recipe file.

    Args:
        name: deform, edit, enlarge or layers.
        settings: what is set, with spans as two numbers and files as paths.
        line: where it stands in the file, from 1.
    """

    name: str
    settings: Settings
    line: int


@dataclass(frozen=True)
class Book:
    """What a recipe file says.

    Args:
        path: the file.
        exemplars: their files.
        seed: of the whole.
        stages: in order.
    """

    path: Path
    exemplars: tuple[Path, ...]
    seed: int
    stages: tuple[StageEntry, ...]

    def files(self) -> dict[str, Path]:
        """All files that decide what is made, by the names they are found under."""
        named = [
            entry.settings[name]
            for entry in self.stages
            for name in ("mask", "plan")
            if name in entry.settings
        ]
        return {str(path): path for path in (self.path, *self.exemplars, *named)}


def read_book(path: str | Path, exemplars: Mapping[str, Path] | None = None) -> Book:
    """A recipe file, checked. File names in it count from its own folder.

    Args:
        exemplars: names that stand for files, such as those of bundled exemplars.

    Raises:
        ValueError: what is wrong, with the line.
        ImportError: without the extra `design`.

    Example:
        >>> import tempfile
        >>> from torchtex import data
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "a.yaml"
        ...     _ = file.write_text("exemplars: [wood]" + chr(10) + "stages: [layers: {count: 2}]")
        ...     book = read_book(file, {"wood": data.path("wood")})
        >>> book.stages[0].name, book.stages[0].line
        ('layers', 2)
    """
    where = Path(path)
    root = _parsed(where)
    reader = _Reader(where, exemplars or {})
    whole = reader.mapping(root, "recipe", ("exemplars", "seed", "stages"))
    for name in ("exemplars", "stages"):
        if name not in whole:
            raise reader.error(root, f"{name} is missing; the recipe needs it")
    names = reader.sequence(whole["exemplars"], "exemplars")
    seed = 0
    if "seed" in whole:
        seed = reader.whole(whole["seed"], "seed")
        if not 0 <= seed < 2**62:
            raise reader.error(whole["seed"], f"seed={seed} must lie in 0..2^62 - 1")
    files = tuple(reader.file(node, "exemplar") for node in names)
    stages = tuple(reader.stage(node) for node in reader.sequence(whole["stages"], "stages"))
    order = [_ORDER.index(entry.name) for entry in stages]
    for entry, before, after in zip(stages[1:], order, order[1:], strict=False):
        if after < before or (after == before and entry.name != "edit"):
            raise ValueError(
                f"recipe={str(where)!r}, line {entry.line}: stage {entry.name} comes too late or "
                f"twice; the order is {', '.join(_ORDER)}"
            )
    if not order or order[-1] < _ORDER.index("enlarge"):
        raise reader.error(whole["stages"], "no stage makes a texture; add enlarge or layers")
    return Book(where, files, seed, stages)


def read_plans(path: str | Path) -> tuple[Plan, ...]:
    """Plans from JSON: a list of operations for every piece, or the report of a design.

    Raises:
        ValueError: what is wrong, with the numbers of layer and operation.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "plan.json"
        ...     _ = file.write_text('[[{"kind": "scale", "amount": 0.9}], []]')
        ...     [len(plan.layers) for plan in read_plans(file)]
        [2]
    """
    text = read_bytes(path, name="plan")
    try:
        value = json.loads(text)
    except ValueError as error:
        raise ValueError(f"plan={str(path)!r} is no JSON ({error})") from None
    if isinstance(value, dict):
        held = value.get("settings", value)
        held = held if isinstance(held, dict) else {}
        plans = held.get("plans", [held["plan"]] if "plan" in held else None)
        if not isinstance(plans, list) or not plans:
            raise ValueError(
                f"plan={str(path)!r} holds no plan; give a list of operations for every piece, or "
                "the report of a design"
            )
        return tuple(Plan.read(plan) for plan in plans)
    return (Plan.read(value),)


def _parsed(path: Path) -> Any:
    yaml = needed("yaml", "recipe")
    try:
        text = read_bytes(path, name="recipe").decode()
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except UnicodeDecodeError:
        raise ValueError(f"recipe={str(path)!r} is no text; write YAML or JSON") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = "" if mark is None else f", line {mark.line + 1}"
        problem = getattr(error, "problem", None) or "no YAML or JSON"
        raise ValueError(f"recipe={str(path)!r}{line}: {problem}; mend the file") from None
    if root is None:
        raise ValueError(f"recipe={str(path)!r} is empty; write exemplars and stages")
    return root


@dataclass(frozen=True)
class _Reader:
    """Values of nodes, and errors that name their lines."""

    path: Path
    names: Mapping[str, Path]

    def error(self, node: Any, words: str) -> ValueError:
        line = node.start_mark.line + 1
        return ValueError(f"recipe={str(self.path)!r}, line {line}: {words}")

    def mapping(self, node: Any, what: str, known: tuple[str, ...]) -> dict[str, Any]:
        if node.id != "mapping":
            raise self.error(node, f"{what} must be names with values; known: {', '.join(known)}")
        found: dict[str, Any] = {}
        for key, value in node.value:
            if key.value not in known:
                raise self.error(
                    key, f"{what} has no {key.value!r}; what there is: {', '.join(known)}"
                )
            if key.value in found:
                raise self.error(key, f"{key.value} of {what} is given twice")
            found[key.value] = value
        return found

    def sequence(self, node: Any, what: str) -> list[Any]:
        if node.id != "sequence" or not node.value:
            raise self.error(node, f"{what} must be a list of at least one")
        return list(node.value)

    def stage(self, node: Any) -> StageEntry:
        if node.id != "mapping" or len(node.value) != 1:
            raise self.error(node, "a stage is one name with its settings, as - layers: {count: 2}")
        key, value = node.value[0]
        if key.value not in KNOWN:
            raise self.error(key, f"stage {key.value!r} is unknown; choose {', '.join(KNOWN)}")
        kinds = KNOWN[key.value]
        if value.id == "scalar" and value.value in ("", "null"):
            items = {}
        else:
            items = self.mapping(value, f"stage {key.value}", tuple(kinds))
        found = {name: self.value(item, name, kinds[name]) for name, item in items.items()}
        if key.value == "edit" and ("mask" in found) == ("path" in found):
            raise self.error(key, "stage edit needs a mask or a path, one of them")
        if key.value in ("enlarge", "layers"):
            self.fitting(key, found)
        return StageEntry(key.value, found, key.start_mark.line + 1)

    def fitting(self, node: Any, found: Settings) -> None:
        """Refuses, before all work, large textures that cannot be."""
        count, size = found.get("count", 1), found.get("size", SIZE)
        if not 1 <= count <= 10000:
            raise self.error(node, f"count={count} must lie in 1..10000")
        if min(size) < 1:
            raise self.error(node, f"size={list(size)} must be at least 1 pixel each")
        cyclic = found.get("cyclic", 0)
        if cyclic and not 2 <= cyclic <= min(size):
            raise self.error(
                node, f"cyclic={cyclic} must lie in 2..{min(size)}, the shorter side of size"
            )

    def value(self, node: Any, name: str, kind: str) -> Any:
        if kind == "file":
            return self.file(node, name)
        if kind == "plan":
            path = self.file(node, name)
            try:
                read_plans(path)
            except ValueError as error:
                raise self.error(node, str(error)) from None
            return path
        if kind in _CHOICES:
            plain = self.plain(node)
            if plain not in _CHOICES[kind]:
                choice = ", ".join(_CHOICES[kind])
                raise self.error(node, f"{name}={plain!r} is unknown; choose {choice}")
            return plain
        plain = self.plain(node)
        if kind == "span":
            span = [plain, plain] if self.number(plain) else plain
            if not self.numbers(span, 2) or span[0] > span[1]:
                raise self.error(node, f"{name}={plain!r} must be {_SPAN}")
            return float(span[0]), float(span[1])
        if kind == "pair":
            if not self.numbers(plain, 2) or not all(isinstance(n, int) for n in plain):
                raise self.error(
                    node, f"{name}={plain!r} must be two whole numbers, [rows, columns]"
                )
            return tuple(plain)
        if kind == "points":
            if not isinstance(plain, list) or not all(self.numbers(p, 2) for p in plain):
                raise self.error(node, f"{name} must be points, [[row, column], ...]")
            return [(float(row), float(col)) for row, col in plain]
        if kind == "flag":
            if not isinstance(plain, bool):
                raise self.error(node, f"{name}={plain!r} must be true or false")
            return plain
        if kind == "whole":
            return self.whole(node, name)
        if not self.number(plain):
            raise self.error(node, f"{name}={plain!r} must be a number")
        return float(plain)

    def whole(self, node: Any, name: str) -> int:
        plain = self.plain(node)
        if not isinstance(plain, int) or isinstance(plain, bool):
            raise self.error(node, f"{name}={plain!r} must be a whole number")
        return plain

    def file(self, node: Any, name: str) -> Path:
        plain = self.plain(node)
        if not isinstance(plain, str):
            raise self.error(node, f"{name}={plain!r} must be the name of a file")
        path = self.path.parent / plain
        if not path.is_file() and plain in self.names:
            path = self.names[plain]
        if not path.is_file():
            raise self.error(node, f"{name}={plain!r}: there is no such file; check the name")
        return path

    @staticmethod
    def plain(node: Any) -> Any:
        import yaml

        loader = yaml.SafeLoader("")
        try:
            return loader.construct_object(node, deep=True)
        finally:
            loader.dispose()

    @staticmethod
    def number(value: Any) -> bool:
        return isinstance(value, _NUMBERS) and not isinstance(value, bool) and abs(value) < 1e9

    def numbers(self, value: Any, count: int) -> bool:
        return isinstance(value, list) and len(value) == count and all(map(self.number, value))
