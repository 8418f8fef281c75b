"""The command line: `torchtex synth`, `apply`, `repeat`, `metrics` and `info`.

Nothing heavy is imported at the top, so that `torchtex --help` answers at once.
"""

import contextlib
import difflib
import hashlib
import json
import os
import re
import signal
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    import torch

FEATURES = ("pixels", "gradients", "haar", "db2", "db3", "db4", "db5", "db6", "db7", "db8")
STARTS = ("blocks", "neighborhoods")
BOUNDARIES = ("free", "periodic")
MATCHES = ("fast", "exact")
EXTRAS = {"plot": ("matplotlib",)}

app = typer.Typer(
    help="Makes textures of any size that look like an exemplar.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


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
            _choose(name, getattr(self, name), allowed)
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
        if self.mask and len(self.mask) != len(self.exemplar):
            raise ValueError(
                f"mask: {len(self.mask)} given for {len(self.exemplar)} exemplars; "
                "repeat --mask once per exemplar"
            )
        if self.target is None and self.target_mask is not None:
            raise ValueError(f"target-mask={self.target_mask!r} needs --target")

    @property
    def height_width(self) -> tuple[int, int]:
        """`size` as numbers."""
        found = re.fullmatch(r"(\d{1,9})[xX](\d{1,9})", self.size)
        if found is None or 0 in (int(found[1]), int(found[2])):
            raise ValueError(
                f"size={self.size!r} must be HEIGHTxWIDTH in pixels, both at least 1, "
                "such as 256x256"
            )
        return int(found[1]), int(found[2])

    def levels(self) -> Sequence[Any]:
        """The schedule as `Level`s, with `steps` in place of its own iterations when given."""
        from torchtex.synthesize import Level, default_schedule

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
        found = {name: _exemplar_path(name) for name in self.exemplar}
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


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        import torchtex

        print(torchtex.__version__)
        raise typer.Exit


@app.command()
def synth(
    exemplar: Annotated[
        list[str],
        typer.Argument(
            help="Pictures, or names of bundled exemplars (see `torchtex info`). Transparent "
            "pixels are not used. Grey ones beside colour ones become RGB."
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="PNG, JPEG or TIFF to write.")],
    size: Annotated[str, typer.Option(help="HEIGHTxWIDTH of the texture in pixels.")],
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
    boundary: Annotated[
        str, typer.Option(help="free, or periodic for a texture that tiles.")
    ] = "free",
    match: Annotated[str, typer.Option(help="Search: fast or exact.")] = "fast",
    mask: Annotated[
        list[str] | None, typer.Option(help="White where the exemplar may be used; one each.")
    ] = None,
    init: Annotated[str | None, typer.Option(help="Picture to start from.")] = None,
    target: Annotated[
        str | None, typer.Option(help="Picture to be pulled to, of the texture's size.")
    ] = None,
    target_mask: Annotated[
        str | None, typer.Option(help="White where the target counts; else all that is opaque.")
    ] = None,
    confidence: Annotated[float, typer.Option(help="Strength of the pull, above 0.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Same seed, same machine: same pixels.")] = 0,
    threads: Annotated[
        int | None, typer.Option(min=1, max=4096, help="CPU threads; changes no pixel.")
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1, mps or xpu.")] = "cpu",
    bits: Annotated[int, typer.Option(help="Per channel of the output: 8 or 16.")] = 8,
    labels: Annotated[Path | None, typer.Option(help=".npz to write for `torchtex apply`.")] = None,
    report: Annotated[
        Path | None, typer.Option(help=".json to write with options, energies and timings.")
    ] = None,
    keep_partial: Annotated[
        bool, typer.Option("--keep-partial", help="On Ctrl-C, write the best texture so far.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
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
    _run(recipe, output, labels, report, threads, keep_partial, quiet)


@app.command()
def apply(
    labels: Annotated[Path, typer.Argument(help="The .npz of `torchtex synth --labels`.")],
    maps: Annotated[
        list[Path],
        typer.Argument(metavar="MAP...", help="Maps aligned with the exemplars, one for each."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="PNG, JPEG or TIFF to write.")],
    bits: Annotated[
        int | None, typer.Option(help="8 or 16; unless given, as many as the map and file allow.")
    ] = None,
) -> None:
    """Render other maps of the same exemplars (normals, height, ...) with the same labels.

    Transparency is dropped.
    """
    import torchtex
    from torchtex import image as images
    from torchtex.labels import LabelField

    _check_output(output, [*maps, labels])
    label_field = LabelField.load(labels)
    loaded = [images.load(path, alpha=False, name="map").image for path in maps]
    for path, values in zip(maps, loaded, strict=True):
        low, high = float(values.min()), float(values.max())
        if low < 0 or high > 1:
            raise ValueError(
                f"map={str(path)!r} has values from {low:g} to {high:g}, which a picture cannot "
                "hold; scale them to 0..1"
            )
    loaded = _same_channels(loaded)
    if bits is None:
        deep = max(_bits(path) for path in maps) == 16
        bits = 16 if deep and _holds(output, len(loaded[0]), 16) else 8
    elif bits not in (8, 16) or not _holds(output, len(loaded[0]), bits):
        raise ValueError(f"bits={bits} cannot be saved as {output.suffix}; use --bits 8, or .png")
    texture = label_field.apply(loaded)
    about = {
        "version": torchtex.__version__,
        "command": "apply",
        "options": {"labels": str(labels), "maps": [str(path) for path in maps], "bits": bits},
    }
    images.save(output, texture, bits=bits, metadata={"torchtex": json.dumps(about)}, name="output")
    print(output)


@app.command()
def repeat(
    result: Annotated[Path, typer.Argument(help="A picture that `torchtex synth` wrote.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="PNG, JPEG or TIFF to write.")],
    labels: Annotated[Path | None, typer.Option(help=".npz to write.")] = None,
    report: Annotated[Path | None, typer.Option(help=".json to write.")] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, max=4096, help="CPU threads; changes no pixel.")
    ] = None,
    keep_partial: Annotated[
        bool, typer.Option("--keep-partial", help="On Ctrl-C, write the best texture so far.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Run again what made RESULT, by the options and file names that it holds.

    Relative names are looked up from the current folder. A file written by --keep-partial is
    made whole.
    """
    import torchtex
    from torchtex import image as images

    text = images.read_metadata(result, name="result").get("torchtex")
    if text is None:
        raise ValueError(
            f"result={str(result)!r} does not say how it was made; "
            "give a picture that torchtex synth wrote"
        )
    about = _stored(result, text)
    recipe = _recipe(result, about["options"])
    for name, path in recipe.files().items():
        if not path.is_file():
            raise ValueError(
                f"result={str(result)!r} was made from {name!r}, which is missing; "
                "put it back, or run from the folder where it was made"
            )
        if _sha256(path) != about["files"].get(name):
            raise ValueError(
                f"result={str(result)!r} was made from {name!r}, which has changed since; "
                "put the old file back"
            )
    if about.get("version") != torchtex.__version__ and not quiet:
        print(
            f"made by torchtex {about.get('version')}, this is {torchtex.__version__}: "
            "pixels may differ",
            file=sys.stderr,
        )
    _run(recipe, output, labels, report, threads, keep_partial, quiet, source=result)


@app.command()
def metrics(
    texture: Annotated[Path, typer.Argument(help="The texture to be measured.")],
    exemplar: Annotated[str, typer.Option(help="What it should look like: picture or name.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    tileable: Annotated[
        bool, typer.Option("--tileable", help="Measure the seam of the tiled texture too.")
    ] = False,
) -> None:
    """Measure how well a texture matches its exemplar. Transparency is dropped."""
    from torchtex import image as images
    from torchtex.metrics import battery

    theirs = images.load(_exemplar_path(exemplar), alpha=False, name="exemplar").image
    ours = images.load(texture, alpha=False, name="texture").image
    ours, theirs = _same_channels([ours, theirs])
    values = battery(ours, theirs, tileable=tileable)
    if as_json:
        print(json.dumps(values, indent=2))
    else:
        for name, value in values.items():
            print(f"{name:10} {value:.4f}")


@app.command()
def info(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print versions, devices, threads, extras and the bundled exemplars."""
    values = _info()
    if as_json:
        print(json.dumps(values, indent=2))
        return
    for name, value in values.items():
        shown = ", ".join(value) if isinstance(value, list) else value
        if isinstance(value, dict):
            shown = ", ".join(f"{key} {item}" for key, item in value.items())
        print(f"{name:12} {shown}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line and exits: 0 done, 2 bad input, 130 interrupted.

    Args:
        arguments: without the program's name; those of the process unless given.

    Example:
        >>> main(["--version"])
        Traceback (most recent call last):
        SystemExit: 0
    """
    # before torch is loaded: threads that wait in a loop take the time of those that work
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    given = list(sys.argv[1:] if arguments is None else arguments)
    command = typer.main.get_command(app)
    with _watching_interrupts():
        code = _guarded(command, given or ["--help"])
    raise SystemExit(code)


def _guarded(command: Any, arguments: Sequence[str]) -> int:
    try:
        code = command.main(list(arguments), prog_name="torchtex", standalone_mode=False)
        if _Interrupts.seen:  # some versions of typer return a code instead of raising
            return _interrupted()
        return code if isinstance(code, int) else 0
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted()
    except typer.Exit as done:
        return done.exit_code
    except (ValueError, ImportError) as error:
        if _Interrupts.seen:
            return _interrupted()
        return _refused(str(error))
    except BrokenPipeError:  # `torchtex info | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if _Interrupts.seen:  # a library may turn the interrupt into an error of its own
            return _interrupted()
        if hasattr(error, "format_message"):  # wrong use of the command line
            return _refused(error.format_message())
        if isinstance(error, MemoryError) or re.search("out of memory|allocate memory", str(error)):
            return _refused("size: there is not enough memory; choose a smaller size or exemplar")
        raise


def _refused(sentence: str) -> int:
    print(f"torchtex: {' '.join(sentence.split())}", file=sys.stderr)
    return 2


def _interrupted() -> int:
    print("torchtex: interrupted", file=sys.stderr)
    return 130


class _Interrupts:
    """Whether Ctrl-C was pressed during the command that runs now."""

    seen = False


@contextlib.contextmanager
def _watching_interrupts() -> Iterator[None]:
    def handle(number: int, frame: Any) -> None:
        _Interrupts.seen = True
        raise KeyboardInterrupt

    _Interrupts.seen = False
    try:
        old = signal.signal(signal.SIGINT, handle)
    except ValueError:  # not the main thread, which alone is interrupted
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, old)


# ------------------------------------------------------------------------------------ the run


def _run(
    recipe: Recipe,
    output: Path,
    labels: Path | None,
    report: Path | None,
    threads: int | None,
    keep_partial: bool,
    quiet: bool,
    source: Path | None = None,
) -> None:
    """Synthesizes and writes; all that can be refused is refused before work starts."""
    import torch

    import torchtex
    from torchtex import image as images
    from torchtex.synthesize import Blocks, RandomNeighborhoods, synthesize

    files = recipe.files()
    _check_output(output, [*files.values(), *([] if source is None else [source])])
    for path, suffix, name in ((labels, ".npz", "labels"), (report, ".json", "report")):
        if path is not None:
            images.check_writable(path, suffixes=(suffix,), name=name)
    if not _holds(output, 3, recipe.bits):
        raise ValueError(f"bits={recipe.bits} cannot be saved as {output.suffix}; use .png")
    schedule = recipe.levels()
    device = _device(recipe.device)
    if threads is not None:
        torch.set_num_threads(threads)
    about: dict[str, Any] = {
        "version": torchtex.__version__,
        "command": "synth",
        "options": asdict(recipe),
        "files": {name: _sha256(path) for name, path in files.items() if path.is_file()},
    }
    inputs = _load(recipe, device)
    if _Interrupts.seen:  # and swallowed by an import, say
        raise KeyboardInterrupt
    with _progress(quiet) as watch:
        try:
            result = synthesize(
                inputs.exemplars,
                recipe.height_width,
                masks=inputs.masks,
                feature=_feature(recipe.feature),
                r=recipe.r,
                completeness=recipe.completeness,
                start=Blocks() if recipe.start == "blocks" else RandomNeighborhoods(),
                init=inputs.init,
                schedule=schedule,
                boundary="periodic" if recipe.boundary == "periodic" else "free",
                search=_search(recipe.match, device.type),
                controls=inputs.controls,
                seed=recipe.seed,
                on_step=watch,
            )
        except (KeyboardInterrupt, Exception) as error:
            if not _Interrupts.seen and not isinstance(error, KeyboardInterrupt):
                raise
            _Interrupts.seen = True
            partial = watch.texture
            if keep_partial and partial is not None:
                whole = images.resize(partial, recipe.height_width)
                about["partial"] = True
                _save(output, whole, recipe.bits, about)
                print(output)
            raise KeyboardInterrupt from None
    about |= result.report()
    _save(output, result.texture, recipe.bits, about)
    if labels is not None:
        result.field.save(labels)
    if report is not None:
        with images.atomic_write(report, name="report") as temporary:
            temporary.write_text(json.dumps(about, indent=2) + "\n")
    print(output)


def _save(output: Path, texture: "torch.Tensor", bits: int, about: dict[str, Any]) -> None:
    from torchtex import image as images

    text = json.dumps(about)
    if len(text) > 30000 and output.suffix.lower() in (".jpg", ".jpeg"):  # holds 64 KB
        text = json.dumps({key: value for key, value in about.items() if key != "levels"})
    images.save(output, texture, bits=bits, metadata={"torchtex": text}, name="output")


def _load(recipe: Recipe, device: "torch.device") -> _Inputs:
    """Reads all pictures of a recipe and moves them to the device."""
    import torch

    from torchtex import image as images
    from torchtex.controls import SoftConstraint

    pictures = [images.load(_exemplar_path(z), name="exemplar") for z in recipe.exemplar]
    exemplars = _same_channels([picture.image for picture in pictures])
    channels = len(exemplars[0])
    masks = [picture.mask for picture in pictures]
    for number, name in enumerate(recipe.mask):
        drawn = images.load_mask(name, _extent(exemplars[number]), name="mask")
        alpha = masks[number]
        both = masks[number] = drawn if alpha is None else drawn & alpha
        if not bool(both.any()):
            raise ValueError(
                f"mask={name!r} is white only where its exemplar is transparent; widen it"
            )
    exemplars = [z.to(device) for z in exemplars]
    masks = [None if mask is None else mask.to(device) for mask in masks]
    inputs = _Inputs(exemplars, masks)
    if recipe.init is not None:
        picture = images.load(recipe.init, alpha=False, name="init")
        inputs.init = _fitting(picture.image, channels, "init", recipe.init).to(device)
    if recipe.target is not None:
        picture = images.load(recipe.target, name="target")
        target = _fitting(picture.image, channels, "target", recipe.target)
        size = recipe.height_width
        if _extent(target) != size:
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


def _same_channels(pictures: "list[torch.Tensor]") -> "list[torch.Tensor]":
    """Grey pictures beside colour ones become RGB."""
    most = max(len(picture) for picture in pictures)
    return [p.expand(most, -1, -1).contiguous() if len(p) < most else p for p in pictures]


def _fitting(picture: "torch.Tensor", channels: int, name: str, path: str) -> "torch.Tensor":
    if len(picture) > channels:
        raise ValueError(
            f"{name}={path!r} is in colour and the exemplar is grey; convert one of them"
        )
    return picture.expand(channels, -1, -1).contiguous()


def _extent(image: "torch.Tensor") -> tuple[int, int]:
    return image.shape[1], image.shape[2]


def _feature(name: str) -> Any:
    from torchtex.features import Gradients, Pixels, Wavelets

    if name == "pixels":
        return Pixels()
    return Gradients() if name == "gradients" else Wavelets(name)


def _search(match: str, device: str) -> Any:
    from torchtex.matching import Chunked
    from torchtex.model import Search, exact_search, fast_search

    if match == "fast":
        return fast_search()
    return exact_search() if device == "cpu" else Search(Chunked())


def _device(name: str) -> "torch.device":
    import torch

    if not re.fullmatch(r"cpu|mps|(cuda|xpu)(:\d{1,3})?", name):
        raise ValueError(f"device={name!r} is unknown; choose cpu, cuda, cuda:1, mps or xpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError):
        raise ValueError(
            f"device={name!r} is not available here; choose one that `torchtex info` lists, "
            "such as cpu"
        ) from None
    return device


# --------------------------------------------------------------------------------- progress


class _Watch:
    """Keeps the last texture and shows how far the run is."""

    def __init__(self, bar: Any = None, quiet: bool = False) -> None:
        self.bar = bar
        self.quiet = quiet
        self.texture: torch.Tensor | None = None
        self.level = -1
        self.task = bar.add_task("start", total=1.0, energy="") if bar is not None else None

    def __call__(self, progress: Any) -> None:
        half, level = progress.half, progress.schedule
        self.texture = half.texture
        if _Interrupts.seen:  # swallowed by a library
            raise KeyboardInterrupt
        name = (
            f"level {progress.level + 1} of {progress.levels}: "
            f"scale {level.scale:g}, window {level.size}"
        )
        if self.bar is not None:
            self.bar.update(
                self.task,
                completed=progress.done,
                description=name,
                energy=f"energy {half.energy:.4g}",
            )
        elif not self.quiet and progress.level != self.level:
            print(name, file=sys.stderr, flush=True)
        self.level = progress.level


@contextlib.contextmanager
def _progress(quiet: bool) -> Iterator[_Watch]:
    """A bar on a terminal, else one line per level, on stderr."""
    if quiet or not sys.stderr.isatty():
        yield _Watch(quiet=quiet)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[energy]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        yield _Watch(bar)


# ------------------------------------------------------------------------------------ files


def _exemplar_path(name: str) -> Path:
    """A file if there is one of that name, else a bundled exemplar."""
    from torchtex import data

    path = Path(name)
    known = data.names()
    if name in known and not path.is_file():
        return data.path(name)
    if not path.exists() and path.name == name and not path.suffix:
        raise ValueError(
            f"exemplar={name!r} is no file and no bundled exemplar; {_hint(name, known)}"
        )
    return path


def _check_output(output: Path, read: Sequence[Path]) -> None:
    """Refuses an output that cannot be written, or that is one of the files to be read."""
    from torchtex import image as images

    images.check_writable(output, suffixes=images.SUFFIXES, name="output")
    for path in read:
        if output.exists() and path.exists() and output.samefile(path):
            raise ValueError(
                f"output={str(output)!r} would overwrite an input; choose another name"
            )


def _holds(output: Path, channels: int, bits: int) -> bool:
    """Whether the format of `output` has so many bits per channel."""
    return bits == 8 or (
        output.suffix.lower() == ".png"
        or (channels == 1 and output.suffix.lower() in (".tif", ".tiff"))
    )


def _bits(path: Path) -> int:
    """16 for a file with more than 8 bits per channel, else 8."""
    from PIL import Image

    with Image.open(path) as picture:
        if picture.format == "PNG":
            with open(path, "rb") as file:
                return 16 if file.read(25)[24] == 16 else 8
        deep = picture.mode == "F" or picture.mode.startswith("I")
        if picture.format == "TIFF":
            deep = deep or max(picture.tag_v2.get(258, (8,))) > 8
    return 16 if deep else 8


def _sha256(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ValueError(f"{str(path)!r} cannot be read: {error.strerror or error}") from None


def _stored(result: Path, text: str) -> dict[str, Any]:
    try:
        about = json.loads(text)
    except ValueError:
        about = None
    if isinstance(about, dict) and about.get("command") == "apply":
        raise ValueError(
            f"result={str(result)!r} was made by torchtex apply; run that again, "
            "or give a picture that torchtex synth wrote"
        )
    wanted = ("options", "files")
    if not isinstance(about, dict) or not all(isinstance(about.get(k), dict) for k in wanted):
        raise ValueError(
            f"result={str(result)!r} holds metadata that is not complete; "
            "give a picture that torchtex synth wrote"
        )
    return about


def _recipe(result: Path, options: dict[str, Any]) -> Recipe:
    """The recipe in stored options; a picture from elsewhere may hold anything."""
    kinds = {
        "exemplar": (list,),
        "mask": (list,),
        "r": (float, int),
        "completeness": (float, int),
        "confidence": (float, int),
        "seed": (int,),
        "bits": (int,),
        "steps": (int, type(None)),
        **dict.fromkeys(("init", "target", "target_mask", "schedule"), (str, type(None))),
    }
    unknown = set(options) ^ {item.name for item in fields(Recipe)}
    wrong = [
        name
        for name, value in options.items()
        if not isinstance(value, kinds.get(name, (str,)))
        or isinstance(value, bool)
        or (isinstance(value, list) and not all(isinstance(item, str) for item in value))
    ]
    if unknown or wrong:
        raise ValueError(
            f"result={str(result)!r} holds options that this version does not know "
            f"({', '.join(sorted({*unknown, *wrong}))}); use the version that made it"
        )
    made: dict[str, Any] = dict(options)
    for name in ("exemplar", "mask"):
        made[name] = tuple(made[name])
    for name in ("r", "completeness", "confidence"):
        made[name] = float(made[name])
    return replace(Recipe(("-",), "1x1"), **made)


# -------------------------------------------------------------------------------------- info


def _info() -> dict[str, Any]:
    import platform

    import torch

    import torchtex
    from torchtex import data
    from torchtex.matching import _faiss

    versions = {"torchtex": torchtex.__version__, "python": platform.python_version()}
    for name in ("torch", "numpy", "kornia", "PyWavelets", "faiss-cpu", "Pillow"):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "missing"
    devices = ["cpu"]
    devices += [f"cuda:{number}" for number in range(torch.cuda.device_count())]
    if torch.backends.mps.is_available():
        devices.append("mps")
    if hasattr(torch, "xpu") and torch.xpu.is_available():
        devices.append("xpu")
    faiss = _faiss()
    options = getattr(faiss, "get_compile_options", str)
    return {
        "versions": versions,
        "devices": devices,
        "threads": torch.get_num_threads(),
        "faiss": options().strip(),
        "extras": {
            extra: "installed" if all(find_spec(module) for module in modules) else "missing"
            for extra, modules in EXTRAS.items()
        },
        "exemplars": list(data.names()),
    }


def _choose(name: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise ValueError(f"{name}={value!r} is unknown; {_hint(value, allowed)}")


def _hint(value: str, allowed: Sequence[str]) -> str:
    near = difflib.get_close_matches(value.lower(), allowed, n=3, cutoff=0.6)
    if near:
        return f"did you mean {' or '.join(near)}?"
    return f"choose {', '.join(allowed)}"


if __name__ == "__main__":
    main()
