"""Options that completion and designs share, and how their words are read."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from torchtex.cli.files import choose, extent_of
from torchtex.cli.layers import load_scribbles
from torchtex.cli.recipe import Outputs, write_report

if TYPE_CHECKING:
    from torchtex.recipes.design_parts import Enlarge
    from torchtex.recipes.montage import Montage

SEARCHES = ("exhaustive", "fft", "qtp")

Patch = Annotated[int, typer.Option(help="Side of the patches that fill holes, in pixels.")]
Order = Annotated[
    str, typer.Option(help="scan: row by row, or confidence: where most is known first.")
]
Searches = Annotated[
    str, typer.Option(help="For patches: fft or exhaustive, all places, or qtp, coarse to fine.")
]


def scribbled(zs: Any, scribbles: list[str]) -> Any:
    """The layers that marks name, of each exemplar."""
    from torchtex.layers.segment import segment

    return [
        segment(z, scribbles=load_scribbles(name, extent_of(z)))
        for z, name in zip(zs, scribbles, strict=True)
    ]


@dataclass(frozen=True)
class DesignOutputs:
    """Outputs whose report alone holds plans: they are as long as a picture is small.

    Args:
        files: what is written.
    """

    files: Outputs

    @property
    def output(self) -> Path:
        """The picture."""
        return self.files.output

    def check(self, read: Mapping[str, Path]) -> None:
        """Refuses, before work starts, what cannot be written."""
        self.files.check(read)

    def write(self, result: "Montage", about: dict[str, Any]) -> None:
        """Writes all of it, the report with plans."""
        settings = {k: v for k, v in about["settings"].items() if k not in ("plan", "plans")}
        replace(self.files, report=None).write(result, about | {"settings": settings})
        write_report(self.files.report, about)

    def write_partial(self, progress: Any, about: dict[str, Any]) -> None:
        """Writes the texture that there was."""
        self.files.write_partial(progress, about)


def order_of(name: str) -> Literal["scan", "confidence"]:
    """An order of completion, checked."""
    choose("order", name, ("scan", "confidence"))
    return "confidence" if name == "confidence" else "scan"


def search_of(name: str) -> Literal["exhaustive", "fft", "qtp"]:
    """A search for patches, checked."""
    choose("search", name, SEARCHES)
    return "qtp" if name == "qtp" else "exhaustive" if name == "exhaustive" else "fft"


def enlarge_of(name: str) -> "Enlarge":
    """A way to enlarge, checked."""
    choose("enlarge", name, ("graphcut", "wavelet", "layers"))
    return "wavelet" if name == "wavelet" else "layers" if name == "layers" else "graphcut"
