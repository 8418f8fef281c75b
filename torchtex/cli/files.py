"""Names, files and sizes that commands are given, checked before work starts."""

import difflib
import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch


def exemplar_path(name: str) -> Path:
    """A file if there is one of that name, else a bundled exemplar."""
    from torchtex import data

    path = Path(name)
    known = data.names()
    if name in known and not path.is_file():
        return data.path(name)
    if not path.exists() and path.name == name and not path.suffix:
        raise ValueError(
            f"exemplar={name!r} is no file and no bundled exemplar; {hint(name, known)}"
        )
    return path


def check_output(output: Path, read: Sequence[Path]) -> None:
    """Refuses an output that cannot be written, or that is one of the files to be read."""
    from torchtex import image as images

    images.check_writable(output, suffixes=images.SUFFIXES, name="output")
    for path in read:
        if output.exists() and path.exists() and output.samefile(path):
            raise ValueError(
                f"output={str(output)!r} would overwrite an input; choose another name"
            )


def holds(output: Path, channels: int, bits: int) -> bool:
    """Whether the format of `output` has so many bits per channel."""
    return bits == 8 or (
        output.suffix.lower() == ".png"
        or (channels == 1 and output.suffix.lower() in (".tif", ".tiff"))
    )


def bits_of(path: Path) -> int:
    """16 for a file with more than 8 bits per channel, else 8."""
    from PIL import Image

    with Image.open(path) as picture:
        if picture.format == "PNG":
            with open(path, "rb") as file:
                return 16 if file.read(25)[24] == 16 else 8
        deep = picture.mode == "F" or picture.mode.startswith("I")
        if picture.format == "TIFF":
            deep = deep or max(picture.tag_v2.get(258, (8,))) > 8
    return 16 if deep else 8


def sha256(path: Path) -> str:
    """Digest of a file, in hexadecimal."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ValueError(f"{str(path)!r} cannot be read: {error.strerror or error}") from None


def same_channels(pictures: "list[torch.Tensor]") -> "list[torch.Tensor]":
    """Grey pictures beside colour ones become RGB."""
    most = max(len(picture) for picture in pictures)
    return [p.expand(most, -1, -1).contiguous() if len(p) < most else p for p in pictures]


def fitting(picture: "torch.Tensor", channels: int, name: str, path: str) -> "torch.Tensor":
    """The picture with as many channels as the exemplar; a grey one is repeated."""
    if len(picture) > channels:
        raise ValueError(
            f"{name}={path!r} is in colour and the exemplar is grey; convert one of them"
        )
    return picture.expand(channels, -1, -1).contiguous()


def extent_of(image: "torch.Tensor") -> tuple[int, int]:
    """Height and width."""
    return image.shape[1], image.shape[2]


def device_of(name: str) -> "torch.device":
    """The device of that name, if it is there."""
    import torch

    if not re.fullmatch(r"cpu|mps|(cuda|xpu)(:\d{1,3})?", name):
        raise ValueError(f"device={name!r} is unknown; choose cpu, cuda, cuda:1, mps or xpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError):
        raise ValueError(
            f"device={name!r} is not available here; choose one that `torchtex info` lists, "
            "such as cpu"
        ) from None
    return device


def choose(name: str, value: str, allowed: Sequence[str]) -> None:
    """Refuses a value that is not allowed, with what is."""
    if value not in allowed:
        raise ValueError(f"{name}={value!r} is unknown; {hint(value, allowed)}")


def hint(value: str, allowed: Sequence[str]) -> str:
    """What may have been meant."""
    near = difflib.get_close_matches(value.lower(), allowed, n=3, cutoff=0.6)
    if near:
        return f"did you mean {' or '.join(near)}?"
    return f"choose {', '.join(allowed)}"


def parse_size(text: str, name: str = "size") -> tuple[int, int]:
    """HEIGHTxWIDTH as numbers.

    Example:
        >>> parse_size("64x96")
        (64, 96)
    """
    found = re.fullmatch(r"(\d{1,9})[xX](\d{1,9})", text)
    if found is None or 0 in (int(found[1]), int(found[2])):
        raise ValueError(
            f"{name}={text!r} must be HEIGHTxWIDTH in pixels, both at least 1, such as 256x256"
        )
    return int(found[1]), int(found[2])


def save_picture(output: Path, texture: "torch.Tensor", bits: int, about: dict[str, Any]) -> None:
    """Writes a picture with what made it."""
    from torchtex import image as images

    text = json.dumps(about)
    if len(text) > 30000 and output.suffix.lower() in (".jpg", ".jpeg"):  # holds 64 KB
        text = json.dumps({key: value for key, value in about.items() if key != "levels"})
    images.save(output, texture, bits=bits, metadata={"torchtex": text}, name="output")
