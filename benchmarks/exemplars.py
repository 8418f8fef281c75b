"""Test exemplars for the benchmarks: a crop of each photo, and the parts that the crop leaves over.

The exemplar is always the top-left corner, at most `limit` pixels a side. What is left of the
photo gives up to two strips that share no pixel with the exemplar or with each other: everything
to the right of it (full height), and everything below it (as wide as the exemplar). A strip less
than `NARROWEST` pixels wide or high is dropped: the spectrum measure needs windows of 64 pixels.
"""

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, UnidentifiedImageError
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "exemplars"
BUNDLED = ROOT / "torchtex" / "exemplars"
NARROWEST = 64


@dataclass(frozen=True)
class Case:
    """One test exemplar, and the disjoint strips of its photo (none where it is too small)."""

    name: str
    exemplar: Float[Tensor, "3 h w"]
    rest: tuple[Tensor, ...] = field(default=())


def add_argument(parser: argparse.ArgumentParser) -> None:
    """The option `--exemplars`, the same for every benchmark."""
    parser.add_argument(
        "--exemplars",
        type=Path,
        metavar="DIR",
        help="folder of exemplar photos (default: ../shared/exemplars beside the repository, "
        "or the bundled ones where that does not exist)",
    )


def default_folder() -> Path:
    """The photos shared with other projects where they exist, otherwise the bundled ones."""
    return SHARED if SHARED.is_dir() else BUNDLED


def load(path: Path) -> Float[Tensor, "3 h w"]:
    """An 8-bit RGB picture as float32 in [0, 1]."""
    try:
        with Image.open(path) as image:
            pixels = np.array(image.convert("RGB"))
    except (UnidentifiedImageError, OSError) as error:
        raise SystemExit(f"{path} cannot be read as a picture ({error})") from None
    return torch.from_numpy(pixels).permute(2, 0, 1).float() / 255


def crop(photo: Float[Tensor, "3 H W"], limit: int) -> Float[Tensor, "3 h w"]:
    """The top-left corner, at most `limit` pixels a side."""
    return photo[:, :limit, :limit].contiguous()


def remainder(photo: Float[Tensor, "3 H W"], limit: int) -> tuple[Tensor, ...]:
    """Disjoint strips of what `crop` leaves over: right of the crop, then below it."""
    strips = photo[:, :, limit:], photo[:, limit:, :limit]
    return tuple(s.contiguous() for s in strips if min(s.shape[1:]) >= NARROWEST)


def cases(folder: Path | None = None, limit: int = 128) -> list[Case]:
    """All exemplars of a folder, by name.

    Args:
        folder: where the PNG photos lie; `default_folder()` when omitted.
        limit: largest side of an exemplar, in pixels.

    Example:
        >>> [case.exemplar.shape for case in cases(limit=64)][0]
        torch.Size([3, 64, 64])
    """
    if limit < NARROWEST:
        raise ValueError(f"limit={limit} must be at least {NARROWEST}: smaller exemplars cannot "
                         "be measured")  # fmt: skip
    folder = default_folder() if folder is None else folder
    paths = sorted(folder.glob("*.png"))
    if not paths:
        raise SystemExit(f"--exemplars {folder} holds no PNG picture; name a folder that does")
    photos = ((path.stem, load(path)) for path in paths)
    return [Case(name, crop(photo, limit), remainder(photo, limit)) for name, photo in photos]
