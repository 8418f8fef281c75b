"""How a command runs a recipe: checks, progress, files written, options kept for `repeat`."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import typer

from torchtex.cli.base import Interrupts, Watch, progress_bar
from torchtex.cli.files import check_outputs, holds, save_picture, sha256

if TYPE_CHECKING:
    import torch

    from torchtex.recipes.montage import Montage
    from torchtex.result import Result

ASIDE = {
    "output", "labels", "report", "threads", "keep_partial", "quiet", "seams", "patch_map",
    "preview", "curve", "pictures", "workers", "cache", "checkpoint", "slices", "keep",
    "flow_picture",
}  # fmt: skip
"""Options that change no pixel: they are not kept, and `repeat` does not take them from a file."""


@runtime_checkable
class Saving(Protocol):
    """What becomes of a result: `Outputs` for textures, others for volumes, meshes and films."""

    @property
    def output(self) -> Path:
        """The file, or the folder, that is named when it is there."""

    def check(self, read: Mapping[str, Path]) -> None:
        """Refuses, before work starts, what cannot be written; `read` are the files read."""

    def write(self, result: Any, about: dict[str, Any]) -> None:
        """Writes all of it, with what made it."""

    def write_partial(self, progress: Any, about: dict[str, Any]) -> None:
        """Writes what an interrupted run had: what `on_step` was given last."""


@dataclass(frozen=True)
class Outputs:
    """What a run that makes a texture writes.

    Args:
        output: the texture.
        bits: per channel of it.
        labels: .npz of the sources, or None.
        report: .json, or None.
        pictures: other pictures, by a function of the result; None is left out.
        files: other files, each with what writes it once all else is written.
        lengthy: settings that the report alone keeps, since they are as long as a picture is small.
    """

    output: Path
    bits: int = 8
    labels: Path | None = None
    report: Path | None = None
    pictures: "list[tuple[str, Path | None, Callable[[Any], torch.Tensor]]]" = field(
        default_factory=list
    )
    files: list[tuple[str, Path | None, Callable[[Path], None]]] = field(default_factory=list)
    lengthy: tuple[str, ...] = ()

    def check(self, read: Mapping[str, Path]) -> None:
        """Refuses, before work starts, what cannot be written.

        Raises:
            ValueError: a name that cannot be written, or that is one of the files to be read.
        """
        from torchtex import image as images

        if self.bits not in (8, 16):
            raise ValueError(f"bits={self.bits} must be 8 or 16")
        if not holds(self.output, 3, self.bits):
            raise ValueError(f"bits={self.bits} cannot be saved as {self.output.suffix}; use .png")
        check_outputs(
            (
                ("output", self.output, images.SUFFIXES),
                ("labels", self.labels, (".npz",)),
                ("report", self.report, (".json",)),
                *((name, path, images.SUFFIXES) for name, path, _ in self.pictures),
                *((name, path, ()) for name, path, _ in self.files),
            ),
            read.values(),
        )

    def write(self, result: "Montage | Result", about: dict[str, Any]) -> None:
        """Writes all of it, the texture with what made it."""
        from torchtex import image as images

        told = about
        if self.lengthy:  # there are results without settings
            kept = {k: v for k, v in about["settings"].items() if k not in self.lengthy}
            told = about | {"settings": kept}
        save_picture(self.output, result.texture, self.bits, told)
        if self.labels is not None:
            result.field.save(self.labels)
        write_report(self.report, about)
        for name, path, draw in self.pictures:
            if path is not None:
                images.save(path, draw(result), name=name)
        for _, path, save in self.files:
            if path is not None:
                save(path)

    def write_partial(self, progress: Any, about: dict[str, Any]) -> None:
        """Writes the texture that there was."""
        save_picture(self.output, progress.texture, self.bits, about)


def write_report(path: Path | None, about: dict[str, Any]) -> None:
    """What made a result, as JSON; None writes nothing."""
    from torchtex import image as images

    if path is not None:
        with images.atomic_write(path, name="report") as temporary:
            temporary.write_text(json.dumps(about, indent=2) + "\n")


def patch_pictures(
    seams: Path | None, patch_map: Path | None
) -> "list[tuple[str, Path | None, Callable[[Any], torch.Tensor]]]":
    """The pictures of seams and of patches that most commands can write."""
    return [
        ("seams", seams, lambda result: result.seam_picture()),
        ("patch_map", patch_map, lambda result: result.patch_picture()),
    ]


def carry_out(
    context: typer.Context,
    outputs: Saving,
    read: Mapping[str, Path],
    make: Callable[[Watch], Any],
    *,
    threads: int | None = None,
    keep_partial: bool = False,
    quiet: bool = False,
) -> None:
    """Runs a recipe and writes what it makes; all that can be refused is refused before.

    Args:
        context: of the command, whose options are kept in the picture.
        outputs: what to write.
        read: the files that decide the pixels, by the names they were given under.
        make: loads, runs the recipe with the given `on_step`, and returns its result, which has a
            `report()` of plain values.
    """
    import torch

    outputs.check(read)
    if threads is not None:
        torch.set_num_threads(threads)
    about = described(context, read, kept_options(context))
    with progress_bar(quiet) as watch:
        try:
            result = make(watch)
        except (KeyboardInterrupt, Exception) as error:
            if not Interrupts.seen and not isinstance(error, KeyboardInterrupt):
                raise
            Interrupts.seen = True
            if keep_partial and watch.last is not None:
                outputs.write_partial(watch.last, about | {"partial": True})
                print(outputs.output)
            raise KeyboardInterrupt from None
    about |= result.report()
    outputs.write(result, about)
    print(outputs.output)


def described(
    context: typer.Context, read: Mapping[str, Path], options: dict[str, Any]
) -> dict[str, Any]:
    """What is kept of how something was made: enough for `repeat`."""
    import torchtex

    return {
        "version": torchtex.__version__,
        "command": context.info_name,
        "options": options,
        "files": {name: sha256(path, _parameter(context, name)) for name, path in read.items()},
    }


def _parameter(context: typer.Context, name: str) -> str:
    """The parameter that a file was named in."""
    for parameter, value in context.params.items():
        if name in map(str, value if isinstance(value, (list, tuple)) else [value]):
            return parameter
    return "file"


def kept_options(context: typer.Context) -> dict[str, Any]:
    """The options of a running command that decide the pixels, as JSON values."""

    def plain(value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            return [plain(item) for item in value]
        return str(value) if isinstance(value, Path) else value

    return {name: plain(value) for name, value in context.params.items() if name not in ASIDE}


def command_line(command: Any, options: Mapping[str, Any]) -> list[str]:
    """Arguments that give a command the options that `kept_options` kept.

    Raises:
        ValueError: an option that the command does not have, or a value that is none.
    """
    line: list[str] = []
    positional: list[str] = []
    known = {parameter.name: parameter for parameter in command.params}
    for name, value in options.items():
        parameter = known.get(name)
        if parameter is None or name in ASIDE:
            raise ValueError(f"option {name} is unknown")
        values = value if isinstance(value, list) else [value]
        if not all(isinstance(item, (str, int, float, bool, type(None))) for item in values):
            raise ValueError(f"option {name} has a value that is none")
        if parameter.param_type_name == "argument":
            positional += [str(item) for item in values]
        elif isinstance(value, bool):
            chosen = parameter.opts if value else parameter.secondary_opts
            line += chosen[:1]
        else:
            line += [f"{parameter.opts[0]}={item}" for item in values if item is not None]
    return [*line, "--", *positional]
