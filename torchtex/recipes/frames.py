"""A frame of a texture that moves along a flow: its error against the one before, its file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.image import atomic_write
from torchtex.recipes.pieces import Pieces
from torchtex.sources import UNREADABLE, SourceField

VISIBLE = 0.9
"""From this confidence on a pixel is the same in both frames, and the warp error counts it."""


@dataclass(frozen=True)
class Frame:
    """One frame of an animation.

    Args:
        number: from 0.
        texture: (c, h, w) in [0, 1].
        field: where its pixels came from; renders aligned maps.
        confidence: (h, w), how far each pixel was already to be seen in the frame before; 0 all
            over in the first.
        warp_error: root mean square difference from the warped frame before, where that is
            seen; 0 in the first.
        seconds: that it took.
        pieces: that it shows, but for those on the way home in a loop.
        home: (h, w), True for pixels that are on the way home already.
        usual: for each exemplar, how often the first frame shows its pixels, 1 in the mean.
    """

    number: int
    texture: Float[Tensor, "c h w"]
    field: SourceField
    confidence: Float[Tensor, "h w"]
    warp_error: float
    seconds: float
    pieces: Pieces
    home: Bool[Tensor, "h w"]
    usual: tuple[Float[Tensor, "_ _"], ...]


def save_frame(path: str | Path, frame: Frame, about: str = "") -> None:
    """Writes a frame as an .npz file that `animate(resume=...)` can go on from.

    Args:
        about: kept with it, for the caller to recognise.

    Example:
        >>> import tempfile
        >>> from torchtex.flow.fields import Uniform
        >>> from torchtex.recipes.animate import animate
        >>> frame = next(animate(torch.rand(1, 32, 32), (32, 32), Uniform((0.0, 1.0)), 2))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_frame(f"{folder}/f.npz", frame)
        ...     load_frame(f"{folder}/f.npz")[0].number
        0
    """
    field, pieces = frame.field, frame.pieces
    arrays: dict[str, Tensor] = {
        "texture": frame.texture,
        "confidence": frame.confidence,
        "home": frame.home,
        "positions": field.positions,
        "weights": field.weights,
        "owner": pieces.owner,
        "before": pieces.before,
        "age": pieces.age,
        "which": pieces.which,
        "source": pieces.source,
        "place": pieces.place,
        **{f"usual{n}": shown for n, shown in enumerate(frame.usual)},
    }
    stored: dict[str, Any] = {name: array.cpu().numpy() for name, array in arrays.items()}
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            number=np.array(frame.number),
            numbers=np.array([frame.warp_error, frame.seconds]),
            shapes=np.array(field.shapes),
            about=np.array(about),
            **stored,
        )


def load_frame(path: str | Path) -> tuple[Frame, str]:
    """Reads what `save_frame` wrote: the frame, and what was kept with it.

    Raises:
        ValueError: no such file, or another kind of file.
    """
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:

            def read(name: str) -> Tensor:
                return torch.from_numpy(file[name])

            error, seconds = (float(number) for number in file["numbers"])
            shapes = tuple((int(h), int(w)) for h, w in file["shapes"])
            names = ("owner", "before", "age", "which", "source", "place")
            frame = Frame(
                int(file["number"]),
                read("texture"),
                SourceField(read("positions"), read("weights"), shapes),
                read("confidence"),
                error,
                seconds,
                Pieces(*(read(name) for name in names)),
                read("home"),
                tuple(read(f"usual{n}") for n in range(len(shapes))),
            )
            return frame, str(file["about"])
    except UNREADABLE as error_:
        raise ValueError(
            f"state={path} is not the state of an animation ({error_}); delete it"
        ) from None


def warp_error(
    texture: Float[Tensor, "c h w"],
    warped: Float[Tensor, "c h w"],
    confidence: Float[Tensor, "h w"],
) -> float:
    """Root mean square difference of two images where the confidence is at least `VISIBLE`.

    Example:
        >>> warp_error(torch.ones(1, 2, 2), torch.zeros(1, 2, 2), torch.ones(2, 2))
        1.0
    """
    seen = confidence >= VISIBLE
    if not bool(seen.any()):
        return 0.0
    return float((texture - warped)[:, seen].square().mean().sqrt())
