"""Options that several commands have, spelled once."""

from pathlib import Path
from typing import Annotated

import typer

Exemplars = Annotated[
    list[str],
    typer.Argument(
        help="Pictures, or names of bundled exemplars (see `torchtex info`). Transparent pixels "
        "are not used. Grey ones beside colour ones become RGB."
    ),
]
ExemplarName = Annotated[
    str, typer.Argument(help="A picture, or the name of a bundled exemplar (see `torchtex info`).")
]
Output = Annotated[Path, typer.Option("-o", "--output", help="PNG, JPEG or TIFF to write.")]
Size = Annotated[str, typer.Option(help="HEIGHTxWIDTH of the texture in pixels.")]
Seed = Annotated[int, typer.Option(help="Same seed, same machine: same pixels.")]
Threads = Annotated[
    int | None, typer.Option(min=1, max=4096, help="CPU threads; changes no pixel.")
]
Device = Annotated[str, typer.Option(help="cpu, cuda, cuda:1, mps or xpu.")]
Masks = Annotated[
    list[str] | None, typer.Option(help="White where the exemplar may be used; one each.")
]
Boundary = Annotated[str, typer.Option(help="free, or periodic for a texture that tiles.")]
Cut = Annotated[
    str, typer.Option(help="Seams: mincut, of any shape, or dp, one pixel in each line.")
]
Solver = Annotated[str | None, typer.Option(help="Of the min-cuts: pymaxflow or ortools.")]
Base = Annotated[
    str, typer.Argument(help="The picture to be changed, or the name of a bundled exemplar.")
]
Plain = Annotated[bool, typer.Option("--plain", help="Copy pixels; no Poisson.")]
Bits = Annotated[int, typer.Option(help="Per channel of the output: 8 or 16.")]
Labels = Annotated[Path | None, typer.Option(help=".npz to write for `torchtex apply`.")]
Report = Annotated[
    Path | None, typer.Option(help=".json to write with options, energies and timings.")
]
SeamPicture = Annotated[Path | None, typer.Option(help="Picture of the seams to write.")]
PatchPicture = Annotated[Path | None, typer.Option(help="Picture of the patches to write.")]
KeepPartial = Annotated[
    bool, typer.Option("--keep-partial", help="On Ctrl-C, write the best texture so far.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress.")]
