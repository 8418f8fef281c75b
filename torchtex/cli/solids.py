"""`torchtex solid`: volumes of texture from pictures."""

import json
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import Watch, app
from torchtex.cli.files import (
    FEATURES,
    check_outputs,
    choose,
    feature_of,
    load_exemplars,
    read_files,
)
from torchtex.cli.options import KeepPartial, Quiet, Report, Seed, Threads
from torchtex.cli.recipe import carry_out, write_report

if TYPE_CHECKING:
    import torch

    from torchtex.recipes.solid_result import Solid, SolidStep


@app.command()
def solid(
    context: typer.Context,
    exemplar: Annotated[
        list[str],
        typer.Argument(
            help="One picture for all axes; two, for the sides and from above; or three, from the "
            "front, from above and from the side, `none` where nothing is prescribed. Names of "
            "bundled exemplars too."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help=".npy, .nrrd, .vti or .zarr to write, or a folder of slices."
        ),
    ],
    size: Annotated[str, typer.Option(help="DEPTHxHEIGHTxWIDTH of the volume in voxels.")],
    method: Annotated[
        str, typer.Option(help="kopf, or skeletal: coarse first, then detail; quicker.")
    ] = "kopf",
    map: Annotated[
        list[str] | None,
        typer.Option(
            help="Picture aligned with an exemplar that is compared too, such as the distance to "
            "the nearest edge; repeat once per exemplar, in the same order."
        ),
    ] = None,
    map_weight: Annotated[float, typer.Option(help="Of the maps beside the colours.")] = 1.0,
    mask: Annotated[
        list[str] | None,
        typer.Option(
            help="White where an exemplar may be used; repeat once per different exemplar. What "
            "is transparent is left out too."
        ),
    ] = None,
    feature: Annotated[
        str, typer.Option(help="What is compared in slices: " + ", ".join(FEATURES))
    ] = "pixels",
    r: Annotated[float, typer.Option(help="Robust exponent in (0, 2]; 2 is least squares.")] = 0.8,
    completeness: Annotated[
        float, typer.Option(help="How strongly unused parts of the exemplar are preferred; 0: not.")
    ] = 50.0,
    histogram: Annotated[
        float, typer.Option(help="How strongly colours that are too frequent lose weight; 0: not.")
    ] = 5.0,
    steps: Annotated[int | None, typer.Option(min=1, help="On every level; kopf alone.")] = None,
    octaves: Annotated[
        int | None,
        typer.Option(help="Halvings of the coarse solid, 1 unless given; skeletal alone."),
    ] = None,
    refine: Annotated[
        int | None,
        typer.Option(
            help="Steps at full scale, 2 unless given; 0: none, as in the paper; skeletal alone."
        ),
    ] = None,
    tiled: Annotated[
        str | None,
        typer.Option(help="DEPTHxHEIGHTxWIDTH to write, filled with copies of the block."),
    ] = None,
    seed: Seed = 0,
    threads: Threads = None,
    bits: Annotated[int, typer.Option(help="Per value of the output: 8, 16 or 32 (floats).")] = 8,
    slices: Annotated[Path | None, typer.Option(help="Picture of four slices to write.")] = None,
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
    """Make a volume whose slices look like the exemplars; it tiles in all directions."""
    from torchtex.recipes.skeletal_solid import skeletal_solid
    from torchtex.recipes.solid import solid as kopf
    from torchtex.recipes.solid import solid_schedule
    from torchtex.recipes.solid_result import SolidCheckpoint

    extent, whole = _extent(size), None if tiled is None else _extent(tiled, "tiled")
    choose("feature", feature, FEATURES)
    choose("method", method, ("kopf", "skeletal"))
    for name, value, of in (
        ("steps", steps, "kopf"), ("octaves", octaves, "skeletal"), ("refine", refine, "skeletal")
    ):  # fmt: skip
        if value is not None and method != of:
            raise ValueError(f"{name}={value} belongs to method={of}; leave one of them out")
    drawn = map or []
    read = read_files(_different(exemplar), mask or [])
    read |= {name: Path(name) for name in drawn}

    def make(watch: Watch) -> "Solid":
        zs, masks = _exemplars(exemplar, mask or [])
        layers = _maps(drawn, exemplar)
        resume = None
        if checkpoint is not None and checkpoint.exists():
            resume = SolidCheckpoint.load(checkpoint)
        common: dict[str, Any] = {
            "maps": layers, "map_weight": map_weight, "masks": masks, "r": r,
            "feature": feature_of(feature), "completeness": completeness,
            "histogram": histogram, "seed": seed, "resume": resume, "on_step": watch,
            "on_level": None if checkpoint is None else lambda state: state.save(checkpoint),
        }  # fmt: skip
        if method == "kopf":
            plan = None if steps is None else solid_schedule(steps)
            return kopf(zs, extent, schedule=plan, **common)
        own = {"octaves": octaves, "refine": refine}
        common |= {name: value for name, value in own.items() if value is not None}
        made = skeletal_solid(zs, extent, **common)
        if not quiet:
            _tell(exemplar, made)
        return made

    outputs = Volumes(output, extent, bits, slices, report, checkpoint, whole)
    carry_out(context, outputs, read, make, threads=threads, keep_partial=keep_partial, quiet=quiet)


@dataclass(frozen=True)
class Volumes:
    """What a run that makes a volume writes.

    Args:
        output: the volume.
        extent: depth, height and width of it.
        bits: per value of it.
        slices: picture of some slices, or None.
        report: .json, or None.
        checkpoint: file that is not needed any more once the volume is written, or None.
        tiled: depth, height and width to fill with copies of the volume, or None.
    """

    output: Path
    extent: tuple[int, int, int]
    bits: int
    slices: Path | None = None
    report: Path | None = None
    checkpoint: Path | None = None
    tiled: tuple[int, int, int] | None = None

    def check(self, read: Mapping[str, Path]) -> None:
        """Refuses, before work starts, what cannot be written."""
        from torchtex import image as images
        from torchtex.recipes.solid_parts import check_tiled
        from torchtex.volumes.files import check_volume_path

        check_volume_path(self.output, bits=self.bits, name="output")
        if self.tiled is not None:
            check_tiled(self.tiled)
        check_outputs(
            (
                ("slices", self.slices, images.SUFFIXES),
                ("report", self.report, (".json",)),
                ("checkpoint", self.checkpoint, (".npz",)),
            ),
            read.values(),
        )
        files = {**read, "slices": self.slices, "report": self.report}
        for name, path in {**files, "checkpoint": self.checkpoint}.items():
            if path is not None and self.output.resolve() in path.resolve().parents:
                raise ValueError(
                    f"output={str(self.output)!r} is replaced as a whole, and {name} is in it, "
                    f"{str(path)!r}; choose another folder"
                )

    def write(self, result: "Solid", about: dict[str, Any]) -> None:
        """Writes all of it, the picture of slices with what made it."""
        from torchtex import image as images
        from torchtex.volumes.files import save_volume

        volume = result.volume if self.tiled is None else result.tiled(self.tiled)
        save_volume(self.output, volume, bits=self.bits, name="output")
        if self.slices is not None:
            told = {"torchtex": json.dumps(about)}
            images.save(self.slices, result.sheet(), metadata=told, name="slices")
        write_report(self.report, about)
        if self.checkpoint is not None:
            self.checkpoint.unlink(missing_ok=True)

    def write_partial(self, progress: "SolidStep", about: dict[str, Any]) -> None:
        """Writes the volume that there was, at full size."""
        from torch.nn.functional import interpolate

        from torchtex.volumes.files import save_volume

        whole = interpolate(progress.volume[None], size=self.extent)[0]
        save_volume(self.output, whole, bits=self.bits, name="output")


def _extent(text: str, name: str = "size") -> tuple[int, int, int]:
    """DEPTHxHEIGHTxWIDTH as numbers."""
    found = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})[xX](\d{1,6})", text)
    if found is None or 0 in (numbers := [int(n) for n in found.groups()]):
        raise ValueError(
            f"{name}={text!r} must be DEPTHxHEIGHTxWIDTH in voxels, all at least 1, such as "
            "64x64x64"
        )
    return numbers[0], numbers[1], numbers[2]


def _tell(names: list[str], made: "Solid") -> None:
    """What is left out of exemplars, since 2^octaves does not divide them."""
    for name, (rows, cols) in zip(_different(names), made.settings["unused"], strict=False):
        if rows or cols:
            print(
                f"exemplar={name!r}: the last {rows} rows and {cols} columns fill no coarse pixel "
                "and are left out",
                file=sys.stderr,
            )


def _different(names: list[str]) -> list[str]:
    """Exemplars that differ, in order."""
    return list(dict.fromkeys(name for name in names if name != "none"))


def _exemplars(
    names: list[str], drawn: list[str]
) -> "tuple[list[torch.Tensor | None], list[torch.Tensor | None]]":
    """Pictures and their masks, the same objects for the same name, and None for `none`."""
    distinct = _different(names)
    if not distinct:
        raise ValueError("exemplar: none given; name at least one picture")
    zs, masks = load_exemplars(distinct, drawn)
    pictures = dict(zip(distinct, zs, strict=True))
    kept = dict(zip(distinct, masks, strict=True))
    return [pictures.get(name) for name in names], [kept.get(name) for name in names]


def _maps(drawn: list[str], names: list[str]) -> "list[torch.Tensor | None] | None":
    """A map for each exemplar, the same object for the same pair of names."""
    from torchtex import image as images

    if not drawn:
        return None
    used = [name for name in names if name != "none"]
    if len(drawn) != len(used):
        raise ValueError(
            f"map: {len(drawn)} given for {len(used)} exemplars; repeat --map once per exemplar"
        )
    loaded = {name: images.load(name, alpha=False, name="map").image for name in drawn}
    rest = iter(drawn)
    return [None if name == "none" else loaded[next(rest)] for name in names]
