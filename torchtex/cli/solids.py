"""`torchtex solid`: volumes of texture from pictures."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchtex.cli.base import Interrupts, app, progress_bar
from torchtex.cli.files import check_outputs, choose, exemplar_path, same_channels, sha256
from torchtex.cli.options import KeepPartial, Quiet, Report, Seed, Threads
from torchtex.cli.recipe import kept_options

if TYPE_CHECKING:
    import torch

    from torchtex.recipes.solid_result import Solid, SolidStep

ASIDE = ("checkpoint", "slices")
"""Options that change no voxel."""


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
    r: Annotated[float, typer.Option(help="Robust exponent in (0, 2]; 2 is least squares.")] = 0.8,
    completeness: Annotated[
        float, typer.Option(help="How strongly unused parts of the exemplar are preferred; 0: not.")
    ] = 50.0,
    histogram: Annotated[
        float, typer.Option(help="How strongly colours that are too frequent lose weight; 0: not.")
    ] = 5.0,
    steps: Annotated[int | None, typer.Option(min=1, help="On every level; kopf alone.")] = None,
    octaves: Annotated[int, typer.Option(help="Of skeletal: halvings of the coarse solid.")] = 1,
    refine: Annotated[
        int, typer.Option(help="Of skeletal: steps at full scale; 0: none, as in the paper.")
    ] = 1,
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
    import torch

    import torchtex
    from torchtex import image as images
    from torchtex.recipes.skeletal_solid import skeletal_solid
    from torchtex.recipes.solid import solid as kopf
    from torchtex.recipes.solid import solid_schedule
    from torchtex.recipes.solid_result import SolidCheckpoint
    from torchtex.volumes.files import check_volume_path, save_volume

    extent = _extent(size)
    choose("method", method, ("kopf", "skeletal"))
    if method == "skeletal" and steps is not None:
        raise ValueError(f"steps={steps} belongs to method=kopf; leave one of them out")
    drawn = map or []
    read = {name: exemplar_path(name) for name in exemplar if name != "none"}
    read |= {name: Path(name) for name in drawn}
    check_volume_path(output, bits=bits, name="output")
    check_outputs(
        (
            ("slices", slices, images.SUFFIXES),
            ("report", report, (".json",)),
            ("checkpoint", checkpoint, (".npz",)),
        ),
        [path for path in read.values() if path.exists()],
    )
    if threads is not None:
        torch.set_num_threads(threads)
    kept = {name: value for name, value in kept_options(context).items() if name not in ASIDE}
    about: dict[str, Any] = {
        "version": torchtex.__version__,
        "command": "solid",
        "options": kept,
        "files": {name: sha256(path, "exemplar") for name, path in read.items()},
    }
    zs = _exemplars(exemplar)
    layers = _maps(drawn, exemplar)
    resume = None
    if checkpoint is not None and checkpoint.exists():
        resume = SolidCheckpoint.load(checkpoint)
    common: dict[str, Any] = {
        "maps": layers, "map_weight": map_weight, "r": r, "completeness": completeness,
        "histogram": histogram, "seed": seed, "resume": resume,
        "on_level": None if checkpoint is None else lambda state: state.save(checkpoint),
    }  # fmt: skip

    def make(on_step: "Callable[[SolidStep], None]") -> "Solid":
        if method == "kopf":
            plan = None if steps is None else solid_schedule(steps)
            return kopf(zs, extent, schedule=plan, on_step=on_step, **common)
        return skeletal_solid(zs, extent, octaves=octaves, refine=refine, on_step=on_step, **common)

    last: list[torch.Tensor] = []
    with progress_bar(quiet) as watch:

        def on_step(step: "SolidStep") -> None:
            last[:] = [step.volume]
            watch(step)

        try:
            made = make(on_step)
        except (KeyboardInterrupt, Exception) as error:
            if not Interrupts.seen and not isinstance(error, KeyboardInterrupt):
                raise
            Interrupts.seen = True
            if keep_partial and last:
                save_volume(output, _enlarged(last[0], extent), bits=bits, name="output")
                print(output)
            raise KeyboardInterrupt from None
    save_volume(output, made.volume, bits=bits, name="output")
    about |= made.report()
    if slices is not None:
        images.save(slices, made.sheet(), metadata={"torchtex": json.dumps(about)}, name="slices")
    if report is not None:
        with images.atomic_write(report, name="report") as temporary:
            temporary.write_text(json.dumps(about, indent=2) + "\n")
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    print(output)


def _extent(text: str) -> tuple[int, int, int]:
    """DEPTHxHEIGHTxWIDTH as numbers."""
    found = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})[xX](\d{1,6})", text)
    if found is None or 0 in (numbers := [int(n) for n in found.groups()]):
        raise ValueError(
            f"size={text!r} must be DEPTHxHEIGHTxWIDTH in voxels, all at least 1, such as 64x64x64"
        )
    return numbers[0], numbers[1], numbers[2]


def _exemplars(names: list[str]) -> "list[torch.Tensor | None]":
    """Pictures, the same object for the same name, and None for `none`."""
    from torchtex import image as images

    distinct = list(dict.fromkeys(name for name in names if name != "none"))
    if not distinct:
        raise ValueError("exemplar: none given; name at least one picture")
    pictures = [images.load(exemplar_path(name), name="exemplar") for name in distinct]
    for name, picture in zip(distinct, pictures, strict=True):
        if picture.mask is not None:
            raise ValueError(
                f"exemplar={name!r} has transparent pixels, which a solid cannot leave out; crop it"
            )
    loaded = dict(zip(distinct, same_channels([p.image for p in pictures]), strict=True))
    return [loaded.get(name) for name in names]


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


def _enlarged(volume: "torch.Tensor", extent: tuple[int, int, int]) -> "torch.Tensor":
    """A preview at full size."""
    from torch.nn.functional import interpolate

    return interpolate(volume[None], size=extent)[0]
