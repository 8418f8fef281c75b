"""Options that completion and designs share, and how their words are read."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from torchtex.cli.files import choose, extent_of
from torchtex.cli.layers import load_scribbles

if TYPE_CHECKING:
    from torchtex.recipes.design_parts import Enlarge

SEARCHES = ("exhaustive", "fft", "qtp")
PLANS = ("plan", "plans")
"""Settings of a design that are long, see `recipe.Outputs`."""

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
