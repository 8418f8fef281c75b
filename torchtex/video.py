"""Writing frames as they come: films, animated pictures, folders of pictures."""

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.extras import needed
from torchtex.image import atomic_write, check_writable, save

FILMS = (".mp4", ".webm", ".mov", ".mkv")
MOVING = (".gif", ".webp", ".apng", ".png")
GIF_RATE = 50.0
"""Frames per second that a GIF holds: it counts in 10 ms, and viewers slow delays of only 10 ms."""
CODECS = {".mp4": "libx264", ".mov": "libx264", ".mkv": "libx264", ".webm": "libvpx-vp9"}


def check_video(path: str | Path, *, name: str = "output") -> None:
    """Refuses, before any work, a film that cannot be written.

    Args:
        path: a film (`FILMS`), an animated picture (`MOVING`), or a folder: a name without an
            ending, made if it is not there.
        name: what an error calls `path`.

    Raises:
        ValueError: another ending, a folder that is missing or not writable.
        ImportError: a film, and imageio-ffmpeg is missing.

    Example:
        >>> check_video("texture.avi")
        Traceback (most recent call last):
        ValueError: output='texture.avi' must end in .mp4, .webm, .mov, .mkv, .gif, .webp, ...
    """
    path = Path(path)
    if is_folder(path):
        if path.exists() and not path.is_dir():
            raise ValueError(
                f"{name}={str(path)!r} is a file; name a folder, or an ending like .mp4"
            )
        if not path.exists() and not path.resolve().parent.is_dir():
            raise ValueError(f"{name}={str(path)!r}: there is no folder to make it in")
        return
    suffix = path.suffix.lower()
    if suffix not in (*FILMS, *MOVING):
        raise ValueError(
            f"{name}={str(path)!r} must end in {', '.join((*FILMS, *MOVING))}, or be a folder"
        )
    check_writable(path, name=name)
    if suffix in FILMS:
        _ffmpeg(name)


def check_rate(rate: float, path: str | Path) -> None:
    """Refuses a number of frames per second that no player shows, or that a GIF cannot hold.

    Args:
        path: the film.

    Raises:
        ValueError: not in 0.1..1000, or above `GIF_RATE` for a GIF.

    Example:
        >>> check_rate(60.0, "texture.webp")
        >>> check_rate(60.0, "texture.gif")
        Traceback (most recent call last):
        ValueError: rate=60.0 is more than the 50 frames per second that a GIF shows; lower it, ...
    """
    if not 0.1 <= rate <= 1000:
        raise ValueError(f"rate={rate} must lie in 0.1..1000 frames per second")
    if Path(path).suffix.lower() == ".gif" and rate > GIF_RATE:
        raise ValueError(
            f"rate={rate} is more than the {GIF_RATE:.0f} frames per second that a GIF shows; "
            "lower it, or write a .webp, .apng or .mp4"
        )


def is_folder(path: Path) -> bool:
    """True for a path that names a folder of frames: no ending, or a folder that is there.

    Example:
        >>> is_folder(Path("frames")), is_folder(Path("film.mp4"))
        (True, False)
    """
    return not path.suffix or path.is_dir()


def frame_name(number: int) -> str:
    """File of a frame in a folder of frames.

    Example:
        >>> frame_name(7)
        'frame_00007.png'
    """
    return f"frame_{number:05}.png"


def frame_numbers(folder: str | Path) -> list[int]:
    """Numbers of the frames in a folder, in order; none if there is no such folder.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / frame_name(7)).write_bytes(b"")
        ...     frame_numbers(folder)
        [7]
    """
    names = {file.name for file in Path(folder).glob("frame_*.png")}
    numbers = (int(name[6:-4]) for name in names if name[6:-4].isdecimal())
    return sorted(number for number in numbers if frame_name(number) in names)


def write_video(
    path: str | Path,
    frames: Iterable[Float[Tensor, "c h w"]],
    *,
    rate: float = 25.0,
    name: str = "output",
) -> int:
    """Writes frames one by one as they come, and returns how many.

    A film holds one frame at a time in memory, a folder too; a GIF keeps what changes between
    frames until it is closed, an APNG all frames. A file appears under its name once it is whole.
    From a folder, frames of a longer film that was there before are removed.

    Args:
        path: see `check_video`.
        frames: (c, h, w) in [0, 1], grey or RGB, all of one size.
        rate: frames per second; delays are whole hundredths of a second in a GIF and whole
            milliseconds in other animated pictures, right on average.

    Raises:
        ValueError: no frames, frames of several sizes, a rate out of range, or what
            `check_video` refuses.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_video(f"{folder}/x.gif", torch.rand(3, 3, 16, 16))
        3
    """
    path = Path(path)
    check_video(path, name=name)
    check_rate(rate, path)
    whole = _alike(frames)
    if is_folder(path):
        path.mkdir(exist_ok=True)
        count = 0
        for frame in whole:
            save(path / frame_name(count), frame, name=name)
            count += 1
        for number in frame_numbers(path):
            if number >= count:
                (path / frame_name(number)).unlink()
        return count
    with atomic_write(path, name=name) as temporary:
        if path.suffix.lower() in FILMS:
            return _film(temporary, whole, rate, name)
        return _moving(temporary, whole, rate)


def _alike(frames: Iterable[Tensor]) -> Iterator[Tensor]:
    """The frames, none of them kept; the first is there once this returns."""
    stream = iter(frames)
    first = next(stream, None)
    if first is None:
        raise ValueError("frames: none given; make at least one")
    return itertools.chain([first], _following(stream, first.shape[1], first.shape[2]))


def _following(stream: Iterator[Tensor], height: int, width: int) -> Iterator[Tensor]:
    for number, frame in enumerate(stream, 1):
        if tuple(frame.shape[1:]) != (height, width):
            raise ValueError(
                f"frame {number} is {frame.shape[1]}x{frame.shape[2]} pixels and frame 0 is "
                f"{height}x{width}; make all of one size"
            )
        yield frame


def _pixels(frame: Tensor) -> Any:
    """8-bit (h, w, 3)."""
    rgb = frame if len(frame) == 3 else frame[:1].expand(3, -1, -1)
    # in float64, as pictures are written: a film is then the same as its frames from a folder
    scaled = (rgb.detach().double().clamp(0, 1) * 255).round().to(torch.uint8)
    return np.ascontiguousarray(scaled.permute(1, 2, 0).cpu().numpy())


def _film(path: Path, frames: Iterator[Tensor], rate: float, name: str) -> int:
    ffmpeg = _ffmpeg(name)
    first = next(frames)
    _, h, w = first.shape
    even = (h + h % 2, w + w % 2)  # what the codecs ask for
    writer = ffmpeg.write_frames(
        str(path),
        (even[1], even[0]),
        fps=rate,
        codec=CODECS[path.suffix.lower()],
        quality=None,
        macro_block_size=1,
        ffmpeg_log_level="error",
        output_params=["-crf", "16", "-pix_fmt", "yuv420p"],
    )
    writer.send(None)
    count = 0
    try:
        for frame in itertools.chain([first], frames):
            pixels = _pixels(frame)
            pad = ((0, even[0] - h), (0, even[1] - w), (0, 0))
            writer.send(np.ascontiguousarray(np.pad(pixels, pad, mode="edge")))
            count += 1
    finally:
        writer.close()
    return count


def _moving(path: Path, frames: Iterator[Tensor], rate: float) -> int:
    from PIL import Image

    kind = {".gif": "GIF", ".webp": "WEBP", ".apng": "PNG", ".png": "PNG"}[path.suffix.lower()]
    unit = 10 if kind == "GIF" else 1  # ms
    delays: list[int] = []  # grows with the frames: Pillow looks up that of a frame once it has it

    def pictures() -> Iterator[Any]:
        for number, frame in enumerate(frames):
            # differences of rounded times, so that roundings do not add up
            begin, end = (round(1000 / rate / unit * n) for n in (number, number + 1))
            delays.append(unit * (end - begin))
            yield Image.fromarray(_pixels(frame))

    stream = pictures()
    first = next(stream)
    options: dict[str, Any] = {"quality": 90} if kind == "WEBP" else {}
    with path.open("wb") as file:  # Pillow leaves a file that it opens open after Ctrl-C
        first.save(
            file,
            format=kind,
            save_all=True,
            append_images=list(stream) if kind == "PNG" else stream,  # an APNG is read twice
            duration=delays,
            loop=0,
            **options,
        )
    return len(delays)


def _ffmpeg(name: str) -> Any:
    instead = "write a .gif, .webp or .apng, or a folder of frames"
    return needed("imageio_ffmpeg", name, otherwise=instead)
