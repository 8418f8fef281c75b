"""Films, animated pictures and folders of frames: what is read back, and what is refused."""

import importlib.util
import subprocess
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex import image as images
from torchtex.video import check_video, frame_name, frame_numbers, is_folder, write_video

needs_ffmpeg = pytest.mark.skipif(
    importlib.util.find_spec("imageio_ffmpeg") is None, reason="imageio_ffmpeg is not installed"
)


def bars(count: int, height: int = 18, width: int = 22, channels: int = 3) -> Tensor:
    """A bright bar that moves by two pixels a frame."""
    frames = torch.full((count, channels, height, width), 0.2)
    for number in range(count):
        frames[number, :, :, 2 * number : 2 * number + 4] = 0.8
    return frames


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".apng", ".png"])
@pytest.mark.parametrize("channels", [1, 3])
def test_animated_pictures_hold_the_frames(tmp_path: Path, suffix: str, channels: int) -> None:
    from PIL import Image

    frames, path = bars(4, channels=channels), tmp_path / f"x{suffix}"
    assert write_video(path, frames, rate=20.0) == 4
    with Image.open(path, formats=["GIF", "WEBP", "PNG"]) as film:
        assert getattr(film, "n_frames") == 4  # noqa: B009
        for number in range(4):
            film.seek(number)
            found = np.asarray(film.convert("RGB")) / 255
            assert np.abs(found - frames[number].numpy().transpose(1, 2, 0)).max() < 0.08
            assert film.info["duration"] == 50
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@needs_ffmpeg
@pytest.mark.parametrize("suffix", [".mp4", ".webm", ".mov", ".mkv"])
def test_films_hold_the_frames(tmp_path: Path, suffix: str) -> None:
    import imageio_ffmpeg

    frames, path = bars(5, 37, 51), tmp_path / f"x{suffix}"  # odd sizes gain a row and a column
    assert write_video(path, frames, rate=10.0) == 5
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    line = [ffmpeg, "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    read = subprocess.run(line, capture_output=True, check=True).stdout
    films = np.frombuffer(read, np.uint8).reshape(-1, 38, 52, 3)[:, :37, :51]
    assert abs(imageio_ffmpeg.count_frames_and_secs(str(path))[1] - 0.5) < 0.01
    assert len(films) == 5
    for film, frame in zip(films, frames, strict=True):
        assert np.abs(film / 255 - frame.numpy().transpose(1, 2, 0)).mean() < 0.05


def test_a_folder_holds_a_picture_of_each_frame(tmp_path: Path) -> None:
    frames = bars(3)
    assert write_video(tmp_path / "frames", frames) == 3
    files = sorted(file.name for file in (tmp_path / "frames").iterdir())
    assert files == [frame_name(number) for number in range(3)]
    read = images.load(tmp_path / "frames" / files[1]).image
    assert (read - frames[1]).abs().max() < 0.5 / 255 + 1e-6


@pytest.mark.parametrize(
    "name", ["x.gif", "x.webp", "frames", pytest.param("x.mp4", marks=needs_ffmpeg)]
)
def test_frames_are_written_as_they_come(tmp_path: Path, name: str) -> None:
    alive: list[weakref.ref[Tensor]] = []
    most = 0

    def frames() -> Iterator[Tensor]:
        nonlocal most
        for frame in bars(8):
            copy = frame.clone()
            alive.append(weakref.ref(copy))
            most = max(most, sum(ref() is not None for ref in alive))
            yield copy
            del copy

    assert write_video(tmp_path / name, frames()) == 8
    assert most <= 3


@pytest.mark.parametrize("name", ["x.gif", "x.apng", pytest.param("x.mp4", marks=needs_ffmpeg)])
def test_an_error_in_a_frame_leaves_no_file(tmp_path: Path, name: str) -> None:
    def frames() -> Iterator[Tensor]:
        yield from bars(2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / name, frames())
    assert list(tmp_path.iterdir()) == []


def test_the_same_frames_give_the_same_file(tmp_path: Path) -> None:
    for name in ("a.gif", "b.gif"):
        write_video(tmp_path / name, (noise(3, 16, 16, seed=seed) for seed in range(3)))
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()


@pytest.mark.parametrize("name", ["x.avi", "x.mp5", "x.jpg", "missing/x.gif", "missing/frames"])
def test_paths_that_cannot_be_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"^film=.*") as caught:
        check_video(tmp_path / name, name="film")
    assert len(str(caught.value).splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "frames").write_text("")
    assert is_folder(tmp_path / "frames")
    with pytest.raises(ValueError, match="is a file; name a folder"):
        check_video(tmp_path / "frames")


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".apng"])
@pytest.mark.parametrize("rate", [23.976, 30.0, 49.0, 50.0])
def test_delays_are_right_on_average(tmp_path: Path, suffix: str, rate: float) -> None:
    from PIL import Image

    write_video(tmp_path / f"x{suffix}", bars(9), rate=rate)
    delays = []
    with Image.open(tmp_path / f"x{suffix}", formats=["GIF", "WEBP", "PNG"]) as film:
        for number in range(9):
            film.seek(number)
            film.load()
            delays.append(film.info["duration"])
    unit = 10 if suffix == ".gif" else 1
    assert abs(sum(delays) - 9000 / rate) <= unit / 2
    assert max(delays) - min(delays) <= unit
    assert min(delays) >= 20


@pytest.mark.parametrize("rate", [50.1, 60.0, 500.0])
def test_rates_that_a_gif_cannot_hold(tmp_path: Path, rate: float) -> None:
    with pytest.raises(ValueError, match=r"rate=.* lower it, or write a \.webp"):
        write_video(tmp_path / "x.gif", bars(2), rate=rate)
    assert write_video(tmp_path / "x.webp", bars(2), rate=rate) == 2


@pytest.mark.parametrize("name", ["x.gif", "x.webp", "x.apng", "frames"])
def test_one_frame_is_a_film(tmp_path: Path, name: str) -> None:
    assert write_video(tmp_path / name, bars(1)) == 1


def test_a_longer_film_does_not_stay_in_a_folder(tmp_path: Path) -> None:
    write_video(tmp_path / "frames", bars(5))
    (tmp_path / "frames" / "frame_9.png").write_text("not ours")
    write_video(tmp_path / "frames", bars(2) / 2)
    assert frame_numbers(tmp_path / "frames") == [0, 1]
    assert (tmp_path / "frames" / "frame_9.png").exists()
    assert frame_numbers(tmp_path / "nowhere") == []


@pytest.mark.parametrize("rate", [0.0, -1.0, 0.01, 1001.0, float("nan")])
def test_rates(tmp_path: Path, rate: float) -> None:
    with pytest.raises(ValueError, match="rate="):
        write_video(tmp_path / "x.gif", bars(2), rate=rate)


def test_no_frames(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="frames"):
        write_video(tmp_path / "x.gif", iter(()))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["x.gif", "frames", pytest.param("x.mp4", marks=needs_ffmpeg)])
def test_frames_of_another_size(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="frame 1 is 9x9 pixels and frame 0 is 18x22"):
        write_video(tmp_path / name, [bars(1)[0], torch.rand(3, 9, 9)])


def test_without_the_encoder_only_films_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"torchtex\[video\]"):
        check_video(tmp_path / "x.mp4")
    check_video(tmp_path / "x.gif")
    check_video(tmp_path / "frames")
