"""`torchtex synth`: texture optimization."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import Interrupts, app, progress_bar
from torchtex.cli.files import (
    FEATURES,
    boundary_of,
    check_masks,
    choose,
    device_of,
    exemplar_path,
    extent_of,
    feature_of,
    fitting,
    load_exemplars,
    parse_size,
    save_picture,
    sha256,
)
from torchtex.cli.options import (
    Bits,
    Boundary,
    Device,
    Exemplars,
    KeepPartial,
    Labels,
    Masks,
    Output,
    Quiet,
    Report,
    Seed,
    Size,
    Threads,
)
from torchtex.cli.recipe import Outputs

if TYPE_CHECKING:
    import torch

STARTS = ("blocks", "neighborhoods")
BOUNDARIES = ("free", "periodic")
MATCHES = ("fast", "exact")


@dataclass(frozen=True)
class Recipe:
    """All options of `torchtex synth` that decide the pixels, as plain values.

    Example:
        >>> Recipe(("gravel",), "64x96").height_width
        (64, 96)
    """

    exemplar: tuple[str, ...]
    size: str
    feature: str = "pixels"
    r: float = 0.8
    completeness: float = 50.0
    start: str = "blocks"
    schedule: str | None = None
    steps: int | None = None
    boundary: str = "free"
    match: str = "fast"
    mask: tuple[str, ...] = ()
    init: str | None = None
    target: str | None = None
    target_mask: str | None = None
    confidence: float = 1.0
    seed: int = 0
    device: str = "cpu"
    bits: int = 8

    def __post_init__(self) -> None:
        _ = self.height_width
        for name, allowed in (
            ("feature", FEATURES),
            ("start", STARTS),
            ("boundary", BOUNDARIES),
            ("match", MATCHES),
        ):
            choose(name, getattr(self, name), allowed)
        if not 0 < self.r <= 2:
            raise ValueError(f"r={self.r} must lie in (0, 2]")
        if not 0 <= self.completeness < float("inf"):
            raise ValueError(f"completeness={self.completeness} must be at least 0, and finite")
        if not 0 < self.confidence < float("inf"):
            raise ValueError(f"confidence={self.confidence} must be above 0, and finite")
        if self.bits not in (8, 16):
            raise ValueError(f"bits={self.bits} must be 8 or 16")
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"seed={self.seed} must lie in 0..2^63 - 1")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps={self.steps} must be at least 1")
        if not self.exemplar:
            raise ValueError("exemplar: none given; give at least one picture")
        check_masks(self.exemplar, self.mask)
        if self.target is None and self.target_mask is not None:
            raise ValueError(f"target-mask={self.target_mask!r} needs --target")

    @property
    def height_width(self) -> tuple[int, int]:
        """`size` as numbers."""
        return parse_size(self.size)

    def levels(self) -> Sequence[Any]:
        """The schedule as `Level`s, with `steps` in place of its own iterations when given."""
        from torchtex.schedule import Level, default_schedule

        if self.schedule is None:
            return default_schedule(self.steps)
        found = []
        for part in self.schedule.split(","):
            try:
                scale, window, steps = part.split(":")
                numbers = float(scale), int(window), int(steps)
            except ValueError:
                raise ValueError(
                    f"schedule={self.schedule!r}: {part!r} is not scale:window:steps; "
                    "write levels like 0.25:8:8,0.5:16:4,1:8:3"
                ) from None
            try:
                found.append(Level(numbers[0], numbers[1], self.steps or numbers[2]))
            except ValueError as error:
                raise ValueError(f"schedule={self.schedule!r}: {error}") from None
        return tuple(found)

    def files(self) -> dict[str, Path]:
        """Every file that is read, by the name it was given under."""
        found = {name: exemplar_path(name) for name in self.exemplar}
        for name in (*self.mask, self.init, self.target, self.target_mask):
            if name is not None:
                found[name] = Path(name)
        return found


@dataclass
class _Inputs:
    """The pictures of a recipe, loaded and checked."""

    exemplars: "list[torch.Tensor]"
    masks: "list[torch.Tensor | None]"
    init: "torch.Tensor | None" = None
    controls: list[tuple[float, Any]] = field(default_factory=list)


@app.command()
def synth(
    exemplar: Exemplars,
    output: Output,
    size: Size,
    feature: Annotated[str, typer.Option(help="What is compared: " + ", ".join(FEATURES))] = (
        "pixels"
    ),
    r: Annotated[float, typer.Option(help="Robust exponent in (0, 2]; 2 is least squares.")] = 0.8,
    completeness: Annotated[
        float, typer.Option(help="How strongly unused parts of the exemplar are preferred; 0: not.")
    ] = 50.0,
    start: Annotated[str, typer.Option(help="First pixels: blocks or neighborhoods.")] = "blocks",
    schedule: Annotated[
        str | None, typer.Option(help="Levels scale:window:steps, such as 0.25:8:8,0.5:16:4,1:8:3.")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="Most iterations on every level; replaces the schedule's.")
    ] = None,
    boundary: Boundary = "free",
    match: Annotated[str, typer.Option(help="Search: fast or exact.")] = "fast",
    mask: Masks = None,
    init: Annotated[str | None, typer.Option(help="Picture to start from.")] = None,
    target: Annotated[
        str | None, typer.Option(help="Picture to be pulled to, of the texture's size.")
    ] = None,
    target_mask: Annotated[
        str | None, typer.Option(help="White where the target counts; else all that is opaque.")
    ] = None,
    confidence: Annotated[float, typer.Option(help="Strength of the pull, above 0.")] = 1.0,
    seed: Seed = 0,
    threads: Threads = None,
    device: Device = "cpu",
    bits: Bits = 8,
    labels: Labels = None,
    report: Report = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            help=".npz to write after each level, and to go on from when it is there; deleted at "
            "the end."
        ),
    ] = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> None:
    """Make a texture of the given size that looks like the exemplars."""
    recipe = Recipe(
        exemplar=tuple(exemplar),
        size=size,
        feature=feature,
        r=r,
        completeness=completeness,
        start=start,
        schedule=schedule,
        steps=steps,
        boundary=boundary,
        match=match,
        mask=tuple(mask or ()),
        init=init,
        target=target,
        target_mask=target_mask,
        confidence=confidence,
        seed=seed,
        device=device,
        bits=bits,
    )
    run(recipe, output, labels, report, threads, keep_partial, quiet, checkpoint=checkpoint)


def run(
    recipe: Recipe,
    output: Path,
    labels: Path | None,
    report: Path | None,
    threads: int | None,
    keep_partial: bool,
    quiet: bool,
    source: Path | None = None,
    checkpoint: Path | None = None,
) -> None:
    """Synthesizes and writes; all that can be refused is refused before work starts."""
    import torch

    import torchtex
    from torchtex import image as images
    from torchtex.result import Checkpoint
    from torchtex.starts import Blocks, RandomNeighborhoods
    from torchtex.synthesize import synthesize

    files = recipe.files()
    outputs = Outputs(output, recipe.bits, labels, report)
    outputs.check(files if source is None else files | {str(source): source})
    if checkpoint is not None:
        images.check_writable(checkpoint, suffixes=(".npz",), name="checkpoint")
    schedule = recipe.levels()
    device = device_of(recipe.device)
    if threads is not None:
        torch.set_num_threads(threads)
    about: dict[str, Any] = {
        "version": torchtex.__version__,
        "command": "synth",
        "options": asdict(recipe),
        "files": {name: sha256(path) for name, path in files.items() if path.is_file()},
    }
    resume = None
    if checkpoint is not None and checkpoint.exists():
        resume = Checkpoint.load(checkpoint)
    inputs = _load(recipe, device)
    if Interrupts.seen:  # and swallowed by an import, say
        raise KeyboardInterrupt
    with progress_bar(quiet) as watch:
        try:
            result = synthesize(
                inputs.exemplars,
                recipe.height_width,
                masks=inputs.masks,
                feature=feature_of(recipe.feature),
                r=recipe.r,
                completeness=recipe.completeness,
                start=Blocks() if recipe.start == "blocks" else RandomNeighborhoods(),
                init=inputs.init,
                schedule=schedule,
                boundary=boundary_of(recipe.boundary),
                search=_search(recipe.match, device.type),
                controls=inputs.controls,
                seed=recipe.seed,
                on_step=watch,
                on_level=None if checkpoint is None else lambda state: state.save(checkpoint),
                resume=resume,
            )
        except (KeyboardInterrupt, Exception) as error:
            if not Interrupts.seen and not isinstance(error, KeyboardInterrupt):
                raise
            Interrupts.seen = True
            if keep_partial and watch.last is not None:
                whole = images.resize(watch.last.texture, recipe.height_width)
                about["partial"] = True
                save_picture(output, whole, recipe.bits, about)
                print(output)
            raise KeyboardInterrupt from None
    about |= result.report()
    outputs.write(result, about)
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    print(output)


def _load(recipe: Recipe, device: "torch.device") -> _Inputs:
    """Reads all pictures of a recipe and moves them to the device."""
    import torch

    from torchtex import image as images
    from torchtex.controls import SoftConstraint

    exemplars, masks = load_exemplars(recipe.exemplar, recipe.mask)
    channels = len(exemplars[0])
    exemplars = [z.to(device) for z in exemplars]
    masks = [None if mask is None else mask.to(device) for mask in masks]
    inputs = _Inputs(exemplars, masks)
    if recipe.init is not None:
        picture = images.load(recipe.init, alpha=False, name="init")
        inputs.init = fitting(picture.image, channels, "init", recipe.init).to(device)
    if recipe.target is not None:
        picture = images.load(recipe.target, name="target")
        target = fitting(picture.image, channels, "target", recipe.target)
        size = recipe.height_width
        if extent_of(target) != size:
            raise ValueError(
                f"target={recipe.target!r} has {target.shape[1]}x{target.shape[2]} pixels and "
                f"size={recipe.size}; give a target of the size of the texture"
            )
        held = torch.ones(size, dtype=torch.bool) if picture.mask is None else picture.mask
        if recipe.target_mask is not None:
            held = held & images.load_mask(recipe.target_mask, size, name="target-mask")
        pull = SoftConstraint(target.to(device), recipe.confidence * held.to(target).to(device))
        inputs.controls.append((1.0, pull))
    return inputs


def _search(match: str, device: str) -> Any:
    from torchtex.matching import Chunked
    from torchtex.model import Search, exact_search, fast_search

    if match == "fast":
        return fast_search()
    return exact_search() if device == "cpu" else Search(Chunked())
