"""The exemplars that come with the package: small crops of photographs, listed in SOURCES.md."""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from torchtex import image

_FOLDER = Path(__file__).parent / "exemplars"


def names() -> tuple[str, ...]:
    """Names of the bundled exemplars, in alphabetical order.

    Example:
        >>> names()
        ('bricks', 'galaxies', 'grass', 'gravel', 'tissue', 'wood')
    """
    return tuple(sorted(file.stem for file in _FOLDER.glob("*.png")))


def path(name: str) -> Path:
    """The PNG file of a bundled exemplar.

    Raises:
        ValueError: no exemplar has this `name`; the message lists those there are.

    Example:
        >>> path("gravel").name
        'gravel.png'
    """
    if name not in names():
        raise ValueError(f"name={name!r} is no bundled exemplar; choose {', '.join(names())}")
    return _FOLDER / f"{name}.png"


def load(name: str) -> Float[Tensor, "c h w"]:
    """A bundled exemplar: float32 in [0, 1], 128 x 128 pixels, one channel (grey) or three.

    Raises:
        ValueError: no exemplar has this `name`; the message lists those there are.

    Source: exemplars/SOURCES.md states where each picture comes from, and its licence.

    Example:
        >>> load("tissue").shape
        torch.Size([3, 128, 128])
        >>> load("gravel").shape
        torch.Size([1, 128, 128])
    """
    return image.load(path(name), name="name").image
