"""`torchtex repeat`: makes again what was made, from the options that it or its report holds."""

import json
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from torchtex.cli.base import app
from torchtex.cli.files import check_other, exemplar_path, sha256
from torchtex.cli.options import KeepPartial, Labels, Quiet, Report, Threads
from torchtex.cli.recipe import command_line
from torchtex.cli.synth import Recipe, run


@app.command()
def repeat(
    result: Annotated[
        Path,
        typer.Argument(help="A picture that `torchtex` wrote, a report, or a folder of frames."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="What the command that made RESULT writes: PNG, JPEG or TIFF, a film, a folder, "
            "a volume or a mesh.",
        ),
    ],
    labels: Labels = None,
    report: Report = None,
    threads: Threads = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> None:
    """Run again what made RESULT, by the options and file names that it holds.

    Relative names are looked up from the current folder. A file written by --keep-partial is
    made whole.
    """
    text = _record(result)
    if text is None:
        raise ValueError(
            f"result={str(result)!r} does not say how it was made; "
            "give a picture that torchtex wrote"
        )
    about = _stored(result, text)
    if about.get("command", "synth") != "synth":
        _check_files(result, about, {name: exemplar_path(name) for name in about["files"]})
        line = _line(result, about)
        if not quiet:
            _tell_version(about)
        _run_again(line, output, labels, report, threads, keep_partial, quiet, result)
        return
    recipe = _recipe(result, about["options"])
    _check_files(result, about, recipe.files())
    if not quiet:
        _tell_version(about)
    run(recipe, output, labels, report, threads, keep_partial, quiet, source=result)


def _record(result: Path) -> str | None:
    """What a file, or the last frame in a folder, says about how it was made."""
    from torchtex import image as images
    from torchtex.video import frame_name, frame_numbers

    if result.suffix.lower() != ".json":
        # a run for more frames wrote the last one
        last = max(frame_numbers(result), default=0)
        picture = result / frame_name(last) if result.is_dir() else result
        return images.read_metadata(picture, name="result").get("torchtex")
    try:
        return result.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ValueError(f"result={str(result)!r}: there is no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"result={str(result)!r} cannot be read ({error})") from None


def _tell_version(about: dict[str, Any]) -> None:
    import torchtex

    if about.get("version") != torchtex.__version__:
        print(
            f"made by torchtex {about.get('version')}, this is {torchtex.__version__}: "
            "pixels may differ",
            file=sys.stderr,
        )


def _check_files(result: Path, about: dict[str, Any], files: dict[str, Path]) -> None:
    for name, path in files.items():
        if not path.is_file():
            raise ValueError(
                f"result={str(result)!r} was made from {name!r}, which is missing; "
                "put it back, or run from the folder where it was made"
            )
        if sha256(path) != about["files"].get(name):
            raise ValueError(
                f"result={str(result)!r} was made from {name!r}, which has changed since; "
                "put the old file back"
            )


def _line(result: Path, about: dict[str, Any]) -> list[str]:
    """The command line of a recipe other than synth; a picture from elsewhere may hold anything."""
    name = about["command"]
    group = typer.main.get_command(app)
    command = getattr(group, "commands", {}).get(name) if isinstance(name, str) else None
    try:
        if command is None:
            raise ValueError(f"command {name} is unknown")
        return [name, *command_line(command, about["options"])]
    except ValueError as error:
        raise ValueError(
            f"result={str(result)!r} cannot be made again by this version ({error}); "
            "use the version that made it"
        ) from None


def _run_again(
    line: list[str],
    output: Path,
    labels: Path | None,
    report: Path | None,
    threads: int | None,
    keep_partial: bool,
    quiet: bool,
    source: Path,
) -> None:
    name, *rest = line
    if source.is_file():
        check_other(output, [source])
    extra = [f"--output={output}"]
    extra += [f"--labels={labels}"] if labels is not None else []
    extra += [f"--report={report}"] if report is not None else []
    extra += [f"--threads={threads}"] if threads is not None else []
    extra += ["--keep-partial"] if keep_partial else []
    extra += ["--quiet"] if quiet else []
    typer.main.get_command(app).main(
        [name, *extra, *rest], prog_name="torchtex", standalone_mode=False
    )


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
            "give a picture that torchtex wrote"
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
