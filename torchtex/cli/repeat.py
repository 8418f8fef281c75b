"""`torchtex repeat`: makes a picture again from the options it holds."""

import json
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from torchtex.cli.base import app
from torchtex.cli.files import sha256
from torchtex.cli.synth import Recipe, run


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
        if sha256(path) != about["files"].get(name):
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
    run(recipe, output, labels, report, threads, keep_partial, quiet, source=result)


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
