"""What all commands share: the program, its exit codes, Ctrl-C, and the progress bar."""

import contextlib
import os
import re
import signal
import sys
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import typer
import typer.core

# what commands are handed is then of the class that they say
typer.core.TyperCommand.context_class = typer.Context

app = typer.Typer(
    help="Makes textures of any size that look like an exemplar.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        import torchtex

        print(torchtex.__version__)
        raise typer.Exit


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
        if Interrupts.seen:  # some versions of typer return a code instead of raising
            return _interrupted()
        return code if isinstance(code, int) else 0
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted()
    except typer.Exit as done:
        return done.exit_code
    except (ValueError, ImportError) as error:
        if Interrupts.seen:
            return _interrupted()
        return _refused(str(error))
    except BrokenPipeError:  # `torchtex info | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if Interrupts.seen:  # a library may turn the interrupt into an error of its own
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


class Interrupts:
    """Whether Ctrl-C was pressed during the command that runs now."""

    seen = False


@contextlib.contextmanager
def _watching_interrupts() -> Iterator[None]:
    def handle(number: int, frame: Any) -> None:
        Interrupts.seen = True
        raise KeyboardInterrupt

    Interrupts.seen = False
    try:
        old = signal.signal(signal.SIGINT, handle)
    except ValueError:  # not the main thread, which alone is interrupted
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, old)


class Watch:
    """Keeps the last step, with its texture, and shows how far the run is."""

    def __init__(self, bar: Any = None, quiet: bool = False) -> None:
        self.bar = bar
        self.quiet = quiet
        self.last: Any = None
        self.note = ""
        self.task = bar.add_task("start", total=1.0, detail="") if bar is not None else None

    def __call__(self, progress: Any) -> None:
        """Takes a `synthesize.Progress`, a `montage.Stage` or a `SolidStep`."""
        self.last = progress
        if Interrupts.seen:  # swallowed by a library
            raise KeyboardInterrupt
        if self.bar is not None:
            self.bar.update(
                self.task,
                completed=progress.done,
                description=progress.note,
                detail=progress.detail,
            )
        elif not self.quiet and progress.note != self.note:
            print(progress.note, file=sys.stderr, flush=True)
        self.note = progress.note


@contextlib.contextmanager
def progress_bar(quiet: bool) -> Iterator[Watch]:
    """A bar on a terminal, else one line per stage, on stderr."""
    if quiet or not sys.stderr.isatty():
        yield Watch(quiet=quiet)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[detail]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        yield Watch(bar)
