"""Runs of recipe files: every stage is kept by a digest of its settings and of what it is given.

So a stage is made again only if it was changed, or one before it.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchtex.image import atomic_write, check_image, load, load_mask
from torchtex.layers.deform import Spread
from torchtex.layers.plans import Chaos
from torchtex.recipes.carried import itself, onto
from torchtex.recipes.design_file import SIZE, Book, StageEntry, read_plans
from torchtex.recipes.design_parts import (
    Layering,
    bases_of,
    closed,
    deformed,
    enlarged,
    finished,
    layers_of,
    taste_of,
    whole_deformed,
)
from torchtex.recipes.layered import Filling, part_seed
from torchtex.recipes.local_edit import edit
from torchtex.recipes.mending import Mending, mended
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.shares import Tell, share
from torchtex.recipes.strokes import Stroke, brush
from torchtex.sources import UNREADABLE, copied

_FORMAT = 3  # of the files in the cache; another one is made anew


@dataclass(frozen=True)
class Made:
    """What a recipe file made.

    Args:
        designs: the textures of its last stages, `enlarge` and `layers`.
        run: for each stage, whether it was run (or taken from the cache).
    """

    designs: list[Montage]
    run: list[tuple[str, bool]]


def run_book(
    book: Book,
    exemplars: Sequence[Tensor],
    *,
    cache: Path | None = None,
    on_step: Tell | None = None,
) -> Made:
    """All stages of a recipe file, those that a cache holds taken from it.

    Args:
        exemplars: what the file names, loaded; all with equal channels.
        cache: a folder; it is made if it is not there. None keeps nothing.
        on_step: called after each step; raise from it to cancel.

    Raises:
        ValueError: what is wrong, with the line of the stage.

    Example:
        >>> from torchtex.recipes.design_file import Book, StageEntry
        >>> z = torch.rand(1, 40, 40, generator=torch.Generator().manual_seed(0))
        >>> stage = StageEntry("enlarge", {"size": (48, 48), "by": "graphcut"}, 1)
        >>> made = run_book(Book(Path("a.yaml"), (Path("z.png"),), 0, (stage,)), [z])
        >>> len(made.designs), made.run
        (1, [('enlarge', True)])
    """
    zs = list(exemplars)
    for z in zs:
        check_image(z, "exemplar")
    if cache is not None:
        cache.mkdir(parents=True, exist_ok=True)
    parts = [itself(zs, number) for number in range(len(zs))]
    found: list[Montage] = []
    run: list[tuple[str, bool]] = []
    part = 1 / max(1, len(book.stages))
    for number, entry in enumerate(book.stages):
        seed = part_seed(book.seed, 1000 * number)
        file = None if cache is None else cache / _name(entry, seed, zs, parts)
        made = None if file is None else _kept(file, zs, seed)
        run.append((entry.name, made is None))
        if made is None:
            made = _run(entry, zs, parts, seed, book, share(on_step, number * part, part))
            if file is not None:
                _keep(file, made)
        if entry.name in ("deform", "edit"):
            parts = made
        else:
            found += made
    settings = {"recipe": "design file", "stages": [e.name for e in book.stages]}
    designs = []
    for one in found:
        plan = {"plan": one.settings["plan"]} if "plan" in one.settings else {}
        designs.append(replace(one, settings=settings | plan, seed=book.seed))
    return Made(designs, run)


def _run(
    entry: StageEntry,
    zs: list[Tensor],
    parts: list[Montage],
    seed: int,
    book: Book,
    told: Tell | None,
) -> list[Montage]:
    stage = {"deform": _deform, "edit": _edit, "enlarge": _enlarge, "layers": _layers}[entry.name]
    try:
        return stage(entry.settings, zs, parts, seed, told)
    except ValueError as error:
        raise ValueError(
            f"recipe={str(book.path)!r}, line {entry.line}, stage {entry.name}: {error}"
        ) from None


def _deform(
    settings: Any, zs: list[Tensor], parts: list[Montage], seed: int, told: Tell | None
) -> list[Montage]:
    """Stage 1: the exemplars, and as many deformations of each."""
    spans = {name: settings[name] for name in settings if name != "count"}
    spread, count = Spread(**spans), _at_least("count", settings.get("count", 2), 0)
    generator = torch.Generator().manual_seed(seed)
    made = list(parts)
    for number in range(len(zs)):
        for _ in range(count):
            drawn = spread.draw(generator)
            made.append(whole_deformed(zs, number, drawn, Filling(), seed))
            done = (len(made) - len(parts)) / (count * len(zs))
            share(told, 0.0, 1.0)(Stage(done, "deform", made[-1].texture))
    return made


def _edit(
    settings: Any, zs: list[Tensor], parts: list[Montage], seed: int, told: Tell | None
) -> list[Montage]:
    """Stage 2: an element of one texture put into another one."""
    base, reference = settings.get("base", 0), settings.get("reference", 0)
    for name, number in (("base", base), ("reference", reference)):
        if not 0 <= number < len(parts):
            raise ValueError(
                f"{name}={number} must lie in 0..{len(parts) - 1}, the textures so far"
            )
    source = parts[reference].texture
    size = (source.shape[1], source.shape[2])
    if "mask" in settings:
        mask = load_mask(settings["mask"], size, name="mask")
    else:
        mask = brush(size, settings["path"], settings.get("radius", 6.0))
    stroke = Stroke(
        mask, settings.get("offset", (0, 0)), settings.get("rotation", 0.0),
        settings.get("scale", 1.0), settings.get("mirror", False),
    )  # fmt: skip
    done = edit(parts[base].texture, [stroke], reference=source, on_step=told)
    made = list(parts)
    made[base] = onto(done, [parts[base], parts[reference]], zs, done.texture)
    return made


def _enlarge(
    settings: Any, zs: list[Tensor], parts: list[Montage], seed: int, told: Tell | None
) -> list[Montage]:
    """Stage 3: large textures from the set."""
    count, extra = _at_least("count", settings.get("count", 1), 1), settings.get("cyclic", 0)
    height, width = _size(settings)
    size, by = (height + extra, width + extra), settings.get("by", "graphcut")
    layering, made = Layering(mending=Mending(turns=settings.get("turns", True))), []
    for number in range(count):
        own, part = part_seed(seed, number), 1 / count
        tell = share(told, number * part, part / 2)
        whole = enlarged(zs, parts, size, by, own, tell, mending=layering.mending)
        if by == "graphcut":
            whole = finished(
                whole, zs, parts, layering, overlap=extra, poisson=settings.get("poisson", False),
                seed=own, on_step=share(told, (number + 0.5) * part, part / 2),
            )  # fmt: skip
        elif extra:
            whole = closed(whole, zs, extra, solved=True)
        made.append(whole)
    return made


def _layers(
    settings: Any, zs: list[Tensor], parts: list[Montage], seed: int, told: Tell | None
) -> list[Montage]:
    """Stage 4: large textures of deformed layers of the set."""
    count, extra = _at_least("count", settings.get("count", 1), 1), settings.get("cyclic", 0)
    height, width = _size(settings)
    layering = Layering(
        settings.get("layers", 3),
        settings.get("method", "graph"),
        Chaos(
            settings.get("map", "logistic"), settings.get("combined", 2),
            settings.get("iterations", 1),
        ),
        filling=Filling(
            settings.get("patch", 32), settings.get("order", "scan"),
            settings.get("search", "fft"),
        ),
        mending=Mending(turns=settings.get("turns", True)),
        variety=settings.get("variety", Layering().variety),
    )  # fmt: skip
    textures = [part.texture for part in parts]
    found = layers_of(textures, layering)
    bases = bases_of(textures, layering, None, seed)
    plans = read_plans(settings["plan"]) if "plan" in settings else ()
    if len(plans) not in (0, 1, count):
        raise ValueError(f"plan: {len(plans)} given for count={count}; give one, or one each")
    made = []
    for number in range(count):
        own, part = part_seed(seed, number), 1 / count
        done = deformed(
            textures, found, bases, (height + extra, width + extra), layering, own,
            share(told, number * part, part / 2),
            plan=plans[number % len(plans)] if plans else None,
        )  # fmt: skip
        done = finished(
            done, textures, bases, layering, overlap=extra,
            taste=taste_of(found, layering.variety, own), seed=own,
            on_step=share(told, (number + 0.5) * part, part / 2),
        )  # fmt: skip
        made.append(_evened(onto(done, parts, zs, None), zs, settings, extra > 0))
    return made


def _evened(whole: Montage, zs: list[Tensor], settings: Any, periodic: bool) -> Montage:
    """Levels along seams evened out, if they are to be."""
    if not settings.get("poisson", False):
        return whole
    return mended(whole, zs, Mending(count=0), periodic=periodic, poisson=True)


def _size(settings: Any) -> tuple[int, int]:
    height, width = settings.get("size", SIZE)
    return height, width


def _at_least(name: str, value: int, least: int) -> int:
    if not least <= value <= 10000:
        raise ValueError(f"{name}={value} must lie in {least}..10000")
    return value


def _name(entry: StageEntry, seed: int, zs: list[Tensor], parts: list[Montage]) -> str:
    """The file that keeps a stage: its name, and a digest of all that decides it."""
    settings = dict(entry.settings)
    for name in ("mask", "plan"):
        if name in settings:
            settings[name] = hashlib.sha256(Path(settings[name]).read_bytes()).hexdigest()
    digest = hashlib.sha256(json.dumps([_FORMAT, entry.name, settings, seed]).encode())
    for image in (*zs, *(tensor for p in parts for tensor in (p.texture, p.field.positions))):
        digest.update(str((image.dtype, tuple(image.shape))).encode())
        digest.update(image.cpu().contiguous().numpy().tobytes())
    return f"{entry.name}-{digest.hexdigest()[:24]}.npz"


def _keep(file: Path, made: list[Montage]) -> None:
    arrays = {}
    for number, one in enumerate(made):
        arrays[f"texture{number}"] = one.texture.cpu().numpy()
        arrays[f"positions{number}"] = one.field.positions[0].cpu().numpy()
        arrays[f"patches{number}"] = one.patches.cpu().numpy()
        arrays[f"settings{number}"] = np.array(json.dumps(dict(one.settings)))
    with atomic_write(file, name="cache") as temporary, open(temporary, "wb") as out:
        np.savez_compressed(out, **arrays)  # type: ignore[arg-type]


def _kept(file: Path, zs: list[Tensor], seed: int) -> list[Montage] | None:
    """What a stage made, if it is kept and whole."""
    if not file.is_file():
        return None
    shapes = [(z.shape[1], z.shape[2]) for z in zs]
    try:
        with open(file, "rb") as raw, np.load(raw, allow_pickle=False) as kept:
            return [
                Montage(
                    torch.from_numpy(kept[f"texture{n}"]).to(zs[0].device),
                    copied(torch.from_numpy(kept[f"positions{n}"]).to(zs[0].device), shapes),
                    torch.from_numpy(kept[f"patches{n}"]).to(zs[0].device),
                    0.0,
                    seed,
                    json.loads(str(kept[f"settings{n}"])),
                )
                for n in range(len(kept.files) // 4)
            ]
    except UNREADABLE:
        return None  # torn or of another make: it is made again


def load_book(book: Book) -> list[Tensor]:
    """The exemplars of a recipe file; grey ones beside colour ones become RGB.

    Example:
        >>> from torchtex import data
        >>> book = Book(Path("a.yaml"), (data.path("gravel"), data.path("wood")), 0, ())
        >>> load_book(book)[0].shape
        torch.Size([3, 128, 128])
    """
    images = [load(path, alpha=False, name="exemplar").image for path in book.exemplars]
    most = max(len(image) for image in images)
    return [image.expand(most, -1, -1).contiguous() for image in images]
