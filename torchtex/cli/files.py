"""Names, files and sizes that commands are given, checked before work starts."""

import difflib
import hashlib
import json
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import torch

    from torchtex.cuts.mincut import MinCut


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


def read_files(exemplars: Sequence[str], drawn: Sequence[str]) -> dict[str, Path]:
    """The files of exemplars and of masks, by the names they were given under."""
    check_masks(exemplars, drawn)
    return {name: exemplar_path(name) for name in exemplars} | {name: Path(name) for name in drawn}


def check_masks(exemplars: Sequence[str], drawn: Sequence[str]) -> None:
    """Refuses a number of masks other than none or one each."""
    if drawn and len(drawn) != len(exemplars):
        raise ValueError(
            f"mask: {len(drawn)} given for {len(exemplars)} exemplars; "
            "repeat --mask once per exemplar"
        )


def load_exemplars(
    names: Sequence[str], drawn: Sequence[str]
) -> "tuple[list[torch.Tensor], list[torch.Tensor | None]]":
    """Exemplars, and where each may be used: where it is opaque, and its mask is white."""
    from torchtex import image as images

    pictures = [images.load(exemplar_path(name), name="exemplar") for name in names]
    masks = [picture.mask for picture in pictures]
    for number, name in enumerate(drawn):
        white = images.load_mask(name, extent_of(pictures[number].image), name="mask")
        alpha = masks[number]
        both = masks[number] = white if alpha is None else white & alpha
        if not bool(both.any()):
            raise ValueError(
                f"mask={name!r} is white only where its exemplar is transparent; widen it"
            )
    return same_channels([picture.image for picture in pictures]), masks


def solver_of(name: str | None, cut: str = "mincut") -> "MinCut | None":
    """The min-cut of that name; None for the first one that is installed."""
    from torchtex.cuts.mincut import OrTools, PyMaxflow, solvers

    if name is None:
        return None
    if cut != "mincut":
        raise ValueError(f"solver={name!r} belongs to cut=mincut; leave one of them out")
    made: dict[str, Callable[[], MinCut]] = {"pymaxflow": PyMaxflow, "ortools": OrTools}
    if name not in made:
        there = ", ".join(known for known, usable in solvers().items() if usable) or "none"
        raise ValueError(f"solver={name!r} is unknown; those installed here: {there}")
    return made[name]()


def cut_of(name: str) -> 'Literal["dp", "mincut"]':
    """The way of cutting of that name."""
    choose("cut", name, ("dp", "mincut"))
    return "dp" if name == "dp" else "mincut"


def boundary_of(name: str) -> 'Literal["free", "periodic"]':
    """The kind of border of that name."""
    choose("boundary", name, ("free", "periodic"))
    return "periodic" if name == "periodic" else "free"


FEATURES = ("pixels", "gradients", "haar", "db2", "db3", "db4", "db5", "db6", "db7", "db8")
"""Names of `feature_of`."""


def feature_of(name: str) -> Any:
    """The feature of that name, which is one of `FEATURES`."""
    from torchtex.features import Gradients, Pixels, Wavelets

    if name == "pixels":
        return Pixels()
    return Gradients() if name == "gradients" else Wavelets(name)


def check_output(
    output: Path, read: Iterable[Path], name: str = "output", suffixes: Sequence[str] | None = None
) -> None:
    """Refuses an output that cannot be written, or that is one of the files to be read.

    Args:
        suffixes: endings allowed; those of pictures unless given.
    """
    from torchtex import image as images

    images.check_writable(
        output, suffixes=images.SUFFIXES if suffixes is None else suffixes, name=name
    )
    check_other(output, read, name)


def check_other(output: Path, read: Iterable[Path], name: str = "output") -> None:
    """Refuses an output that is one of the files to be read."""
    for path in read:
        if output.exists() and path.exists() and output.samefile(path):
            raise ValueError(
                f"{name}={str(output)!r} would overwrite an input; choose another name"
            )


def check_outputs(
    outputs: "Iterable[tuple[str, Path | None, Sequence[str]]]", read: Collection[Path]
) -> None:
    """`check_output` for several, each a parameter, a path or None, and the endings allowed.

    Raises:
        ValueError: as there, or two are one file.
    """
    written: list[Path] = []
    for name, path, suffixes in outputs:
        if path is None:
            continue
        check_output(path, read, name, suffixes)
        if path.resolve() in written:
            raise ValueError(f"{name}={str(path)!r} is another output too; choose another name")
        written.append(path.resolve())


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


def sha256(path: Path, name: str = "file") -> str:
    """Digest of a file, in hexadecimal; an error calls the file by that name."""
    from torchtex import image as images

    return hashlib.sha256(images.read_bytes(path, name=name)).hexdigest()


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
