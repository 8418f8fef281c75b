"""`torchtex design --recipe FILE`: runs the stages of a recipe file and writes what they make."""

from pathlib import Path

import typer

from torchtex.cli.base import progress_bar
from torchtex.cli.design_options import PLANS
from torchtex.cli.layers import numbered
from torchtex.cli.recipe import ASIDE, Outputs, described, kept_options


def run_file(
    context: typer.Context,
    recipe: Path,
    output: Path,
    report: Path | None,
    cache: Path | None,
    only: int | None,
    exemplars: list[str],
    bits: int,
    threads: int | None,
    quiet: bool,
) -> None:
    """Runs a recipe file; one design is written as the output, several as NAME_1.png, ..."""
    import torch

    from torchtex import data
    from torchtex.recipes.design_file import read_book
    from torchtex.recipes.design_stages import load_book, run_book

    if exemplars:
        raise ValueError(
            f"exemplar={exemplars[0]!r} beside recipe={str(recipe)!r}, which names exemplars "
            "itself; leave one of them out"
        )
    _refuse_others(context)
    book = read_book(recipe, {name: data.path(name) for name in data.names()})
    if cache is not None and cache.exists() and not cache.is_dir():
        raise ValueError(f"cache={str(cache)!r} is no folder; choose another name")
    if cache is not None and not cache.absolute().parent.is_dir():
        raise ValueError(f"cache={str(cache)!r}: there is no folder to make it in; create it first")
    count = sum(
        entry.settings.get("count", 1)
        for entry in book.stages
        if entry.name in ("enlarge", "layers")
    )
    files = book.files()
    if only is not None and not 1 <= only <= count:
        raise ValueError(f"only={only} must lie in 1..{count}, the designs of the recipe")
    wanted = list(range(1, count + 1)) if only is None else [only]
    alone = len(wanted) == 1
    outputs = []
    for number in wanted:
        name = output if alone else numbered(output, number)
        told = report if report is None or alone else numbered(report, number)
        outputs.append(Outputs(name, bits, report=told, lengthy=PLANS))
        outputs[-1].check(files)
    if threads is not None:
        torch.set_num_threads(threads)
    with progress_bar(quiet) as watch:
        made = run_book(book, load_book(book), cache=cache, on_step=watch)
    about = described(context, {str(recipe): recipe} | files, kept_options(context))
    about["stages"] = [{"stage": name, "run": run} for name, run in made.run]
    for files_of, number in zip(outputs, wanted, strict=True):
        result = made.designs[number - 1]
        own = about | {"options": about["options"] | {"only": number}}
        files_of.write(result, own | result.report())
        print(files_of.output)


def _refuse_others(context: typer.Context) -> None:
    """Options that the file decides must not be given beside it."""
    allowed = {
        "recipe",
        "output",
        "report",
        "cache",
        "only",
        "bits",
        "threads",
        "quiet",
        "exemplar",
        "workers",
    }
    given = [
        parameter.name
        for parameter in context.command.params
        if parameter.name not in allowed
        and (context.params[parameter.name] or None) != (parameter.default or None)
    ]
    if given:
        option = str(given[0]).replace("_", "-")
        if given[0] in ASIDE:
            raise ValueError(f"{option} does not go with --recipe; leave it out")
        raise ValueError(f"{option} is decided by --recipe; write it into the file")
