"""`torchtex animate`: textures that move along a flow."""

import contextlib
import itertools
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import Watch, app
from torchtex.cli.files import (
    check_outputs,
    load_exemplars,
    parse_size,
    read_files,
    solver_of,
)
from torchtex.cli.frame_folder import FrameFolder
from torchtex.cli.options import (
    Exemplars,
    KeepPartial,
    Masks,
    Quiet,
    Report,
    Seed,
    Size,
    Solver,
    Threads,
)
from torchtex.cli.recipe import carry_out, described, kept_options, write_report

if TYPE_CHECKING:
    import torch


@app.command()
def animate(
    context: typer.Context,
    exemplar: Exemplars,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help=".mp4, .webm, .mov, .mkv, .gif, .webp, .apng, .png (an APNG), or a folder.",
        ),
    ],
    size: Size,
    flow: Annotated[
        str,
        typer.Option(
            help="Where pixels go: uniform:0,2 sink:1.5 rotation:2 pair:3 gyre fluid "
            "strokes:FILE.json ..., sums with +, or a .npy, .npz or .flo file."
        ),
    ],
    frames: Annotated[int, typer.Option(help="How many frames.")],
    flow_scale: Annotated[float, typer.Option(help="Makes the flow so much faster.")] = 1.0,
    patch: Annotated[
        int, typer.Option(help="Side of the pieces that move as wholes, pixels; above an object's.")
    ] = 48,
    hold: Annotated[
        float,
        typer.Option(help="How closely to keep to the warped frame before, against 1 for a seam."),
    ] = 0.1,
    follow: Annotated[
        float, typer.Option(help="Cost of content that moves otherwise than the flow.")
    ] = 0.01,
    repeat: Annotated[
        float, typer.Option(help="How far new content keeps away from what is shown already.")
    ] = 1.0,
    balance: Annotated[
        float,
        typer.Option(help="Cost of content that is shown more often than in the first frame."),
    ] = 0.045,
    mend: Annotated[
        int, typer.Option(help="New pieces tried per frame, over its worst seams.")
    ] = 12,
    fade: Annotated[int, typer.Option(help="Frames over which content passes into new.")] = 3,
    steps: Annotated[
        int, typer.Option(help="Steps per pixel; 1 copies whole pixels, and moves less smoothly.")
    ] = 4,
    loop: Annotated[
        int, typer.Option(help="Return to the first frame over so many frames at the end.")
    ] = 0,
    boundary: Annotated[str, typer.Option(help="free, or periodic for frames that tile.")] = "free",
    rate: Annotated[float, typer.Option(help="Frames per second; at most 50 in a .gif.")] = 25.0,
    mask: Masks = None,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare", help="Beside it a plain warp, and a warp that is regenerated, in one film."
        ),
    ] = False,
    preview: Annotated[
        int | None, typer.Option(help="Only so many of the frames, from the first one.")
    ] = None,
    keep: Annotated[
        Path | None,
        typer.Option(help="Folder for the frames, and to go on from after an interrupt."),
    ] = None,
    flow_picture: Annotated[
        Path | None, typer.Option(help="Picture of the first flow field to write.")
    ] = None,
    solver: Solver = None,
    seed: Seed = 0,
    threads: Threads = None,
    report: Report = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> None:
    """Move a texture along a flow, frame by frame; it stays a texture.

    A folder as output, or --keep, goes on where a run of the same options stopped: after an
    interrupt, after --preview, or for more --frames. Its state.npz is what it goes on from, and
    may be deleted in the end. The frames in a folder say how they were made, and so does a report:
    `torchtex repeat` takes either.
    """
    from torchtex import image as images
    from torchtex.flow.fields import Scaled
    from torchtex.flow.words import parse_flow, untiled
    from torchtex.recipes.animate import Motion
    from torchtex.recipes.animate import animate as animated
    from torchtex.recipes.montage import Stage
    from torchtex.video import is_folder, write_video

    height_width = parse_size(size)
    if boundary not in ("free", "periodic"):
        raise ValueError(f"boundary={boundary!r} must be free or periodic")
    if preview is not None and preview < 1:
        raise ValueError(f"preview={preview} must be at least 1")
    wanted = frames if preview is None else min(frames, preview)
    motion = Motion(
        patch=patch, hold=hold, follow=follow, repeat=repeat, balance=balance, mend=mend,
        fade=fade, steps=steps,
    )  # fmt: skip
    chosen = solver_of(solver)
    field = parse_flow(flow)
    moving = field if flow_scale == 1 else Scaled(field, flow_scale)
    if boundary == "periodic" and not quiet:
        for sentence in untiled(flow):
            print(f"note: {sentence}", file=sys.stderr)
    read = read_files(exemplar, mask or [])
    outputs = Films(output, keep, rate, compare, report, flow_picture)
    into = is_folder(output)
    folder, called = (output, "output") if into else (keep, "keep")

    def make(watch: Watch) -> _Run:
        record = described(context, read, kept_options(context))
        about = record | {"options": _deciding(context)}
        zs, masks = load_exemplars(exemplar, mask or [])
        store = None if folder is None else FrameFolder(folder, called, about, record)
        resume, lines = (None, []) if store is None else store.resumed(wanted if into else None)
        lines = lines[:wanted]
        made = animated(
            zs, height_width, moving, frames, masks=masks, motion=motion, boundary=boundary,
            loop=loop, solver=chosen, seed=seed, resume=resume,
        )  # fmt: skip
        if flow_picture is not None:
            from torchtex.flow.pictures import flow_picture as drawn

            first = moving(0, *height_width)
            images.save(flow_picture, drawn(first, periodic=boundary == "periodic"))

        def stream() -> "Iterator[torch.Tensor]":
            if store is not None and resume is not None:
                yield from store.pictures(min(wanted, resume.number + 1))
            with (
                contextlib.suppress(KeyboardInterrupt) if keep_partial else contextlib.nullcontext()
            ):
                begin = 0 if resume is None else resume.number + 1
                for frame in itertools.islice(made, max(0, wanted - begin)):
                    detail = f"{frame.number + 1} of {wanted}, {frame.seconds:.1f} s a frame"
                    done = (frame.number + 1) / wanted
                    watch(Stage(done, "frames", frame.texture, detail))
                    lines.append(
                        {
                            "frame": frame.number,
                            "warp_error": frame.warp_error,
                            "seconds": frame.seconds,
                        }
                    )
                    if store is not None:
                        store.keep(frame, lines)
                    yield frame.texture

        shown = stream()
        if compare:
            shown = _beside(shown, moving, frames, boundary == "periodic")
        if into:
            for _ in shown:  # the store writes them
                pass
        else:
            write_video(output, shown, rate=rate)
        return _Run(lines)

    carry_out(context, outputs, read, make, threads=threads, quiet=quiet)


@dataclass(frozen=True)
class _Run:
    """The record of frames that were made."""

    frames: list[dict[str, Any]]

    def report(self) -> dict[str, Any]:
        return {"frames": self.frames}


@dataclass(frozen=True)
class Films:
    """What an animation writes; its frames are written as they come, so that none is held.

    Args:
        output: the film, or a folder of frames.
        keep: folder of frames beside it, or None.
        rate: frames per second.
        compare: whether others stand beside it.
        report: .json, or None.
        flow_picture: picture of the first flow field, or None.
    """

    output: Path
    keep: Path | None
    rate: float
    compare: bool
    report: Path | None
    flow_picture: Path | None

    def check(self, read: Mapping[str, Path]) -> None:
        """Refuses, before any work, what cannot be written."""
        from torchtex import image as images
        from torchtex.video import check_rate, check_video, is_folder

        check_video(self.output)
        check_rate(self.rate, self.output)
        if is_folder(self.output) and self.compare:
            raise ValueError(
                f"compare needs a film, and output={str(self.output)!r} is a folder; name a film, "
                "and a folder with --keep"
            )
        if self.keep is not None:
            if self.keep.exists() and not self.keep.is_dir():
                raise ValueError(f"keep={str(self.keep)!r} is a file; name a folder")
            if not self.keep.resolve().parent.is_dir():
                raise ValueError(f"keep={str(self.keep)!r}: there is no folder to make it in")
        check_outputs(
            (
                ("output", None if is_folder(self.output) else self.output, ()),
                ("report", self.report, (".json",)),
                ("flow-picture", self.flow_picture, images.SUFFIXES),
            ),
            read.values(),
        )

    def write(self, result: _Run, about: dict[str, Any]) -> None:
        """Writes the report; all else is there."""
        write_report(self.report, about)

    def write_partial(self, progress: Any, about: dict[str, Any]) -> None:
        """Nothing: what was made is there."""


def _deciding(context: typer.Context) -> dict[str, Any]:
    """The options that decide the frames: not where they go, nor how many of them are wanted."""
    aside = ["rate", "compare"]
    if not context.params["loop"]:
        aside.append("frames")
    return {name: value for name, value in kept_options(context).items() if name not in aside}


def _beside(
    frames: "Iterator[torch.Tensor]", flow: Any, count: int, periodic: bool
) -> "Iterator[torch.Tensor]":
    """Ours, a plain warp and a regenerated one, side by side."""
    import torch

    from torchtex.recipes.regeneration import regenerated_frames, warped_frames

    first = next(frames)
    plain = warped_frames(first, flow, count, periodic=periodic)
    anew = regenerated_frames(first, flow, count, periodic=periodic)
    yield torch.cat([first, next(plain), next(anew)], 2)
    for ours, one, two in zip(frames, plain, anew, strict=False):
        yield torch.cat([ours, one, two], 2)
