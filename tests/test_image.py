"""Pictures in and out, checks, resizing."""

import contextlib
import doctest
import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

from torchtex import image


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def noise(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def levels(*shape: int, bits: int = 8, seed: int = 0) -> np.ndarray:
    draw = np.random.default_rng(seed).integers(0, 2**bits, shape)
    return draw.astype(np.uint8 if bits == 8 else np.uint16)


def as_levels(x: Tensor, bits: int = 8) -> np.ndarray:
    """What `image.load` gave, back as (h, w, c) whole numbers."""
    exact = x.permute(1, 2, 0).numpy().astype(np.float64) * (2**bits - 1)
    assert np.abs(exact - exact.round()).max() < 0.01
    return exact.round().astype(int)


# ---------------------------------------------------------------------------------- reading


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".webp", ".gif"])
def test_grey_stays_one_channel(tmp_path: Path, suffix: str) -> None:
    pixels = levels(9, 7)
    Image.fromarray(pixels).save(tmp_path / f"x{suffix}", lossless=True)
    picture = image.load(tmp_path / f"x{suffix}")
    assert picture.image.dtype == torch.float32
    assert picture.mask is None
    if suffix in (".webp", ".gif"):  # these store colours
        assert picture.image.shape == (3, 9, 7)
    else:
        assert np.array_equal(as_levels(picture.image), pixels[..., None])


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".webp"])
def test_rgb_is_read_exactly(tmp_path: Path, suffix: str) -> None:
    pixels = levels(9, 7, 3)
    Image.fromarray(pixels).save(tmp_path / f"x{suffix}", lossless=True)
    assert np.array_equal(as_levels(image.load(str(tmp_path / f"x{suffix}")).image), pixels)


def test_one_bit(tmp_path: Path) -> None:
    pixels = levels(9, 7) > 127
    Image.fromarray(pixels).save(tmp_path / "x.png")
    assert np.array_equal(image.load(tmp_path / "x.png").image[0].numpy(), pixels)


@pytest.mark.parametrize("channels", [2, 4])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_alpha_is_a_mask_and_leaves_colours_alone(
    tmp_path: Path, suffix: str, channels: int
) -> None:
    pixels = levels(9, 7, channels)
    Image.fromarray(pixels).save(tmp_path / f"x{suffix}")
    picture = image.load(tmp_path / f"x{suffix}")
    assert np.array_equal(as_levels(picture.image), pixels[..., :-1])
    assert picture.mask is not None
    assert np.array_equal(picture.mask.numpy(), pixels[..., -1] > 127)
    assert image.load(tmp_path / f"x{suffix}", alpha=False).mask is None


def test_opaque_alpha_is_no_mask_and_clear_alpha_is_refused(tmp_path: Path) -> None:
    pixels = levels(4, 5, 4)
    pixels[..., 3] = 255
    Image.fromarray(pixels).save(tmp_path / "full.png")
    assert image.load(tmp_path / "full.png").mask is None
    pixels[..., 3] = 0
    Image.fromarray(pixels).save(tmp_path / "clear.png")
    with pytest.raises(ValueError, match=r"exemplar='.*clear.png' is transparent everywhere"):
        image.load(tmp_path / "clear.png", name="exemplar")
    assert image.load(tmp_path / "clear.png", alpha=False).image.shape == (3, 4, 5)


def test_palette_becomes_rgb_and_its_transparency_a_mask(tmp_path: Path) -> None:
    index = levels(9, 7) % 3
    colours = [(255, 0, 0), (0, 128, 0), (0, 0, 64)]
    picture = Image.fromarray(index, mode=None).convert("P")
    picture.putdata(index.flatten().tolist())
    picture.putpalette([value for colour in colours for value in colour])
    picture.save(tmp_path / "plain.png")
    picture.save(tmp_path / "some.png", transparency=1)
    picture.save(tmp_path / "bytes.png", transparency=bytes([255, 100, 200]))
    wanted = np.array(colours)[index]
    for name in ("plain", "some", "bytes"):
        read = image.load(tmp_path / f"{name}.png")
        assert np.array_equal(as_levels(read.image), wanted)
        assert (read.mask is None) == (name == "plain")
        if read.mask is not None:
            assert np.array_equal(read.mask.numpy(), index != 1)


def test_a_transparent_colour_is_a_mask(tmp_path: Path) -> None:
    grey, rgb = levels(9, 7) % 4, levels(9, 7, 3) % 2
    Image.fromarray(grey).save(tmp_path / "grey.png", transparency=2)
    Image.fromarray(rgb).save(tmp_path / "rgb.png", transparency=(1, 0, 1))
    mask = image.load(tmp_path / "grey.png").mask
    assert mask is not None
    assert np.array_equal(mask.numpy(), grey != 2)
    mask = image.load(tmp_path / "rgb.png").mask
    assert mask is not None
    assert np.array_equal(mask.numpy(), (rgb != (1, 0, 1)).any(-1))


def test_cmyk_jpeg_becomes_rgb(tmp_path: Path) -> None:
    Image.new("CMYK", (16, 8), (0, 255, 255, 0)).save(tmp_path / "x.jpg", quality=100)
    read = image.load(tmp_path / "x.jpg").image
    assert read.shape == (3, 8, 16)
    assert (read - torch.tensor([1.0, 0, 0])[:, None, None]).abs().max() < 0.03


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_honoured(tmp_path: Path, orientation: int) -> None:
    pixels = np.zeros((16, 32, 3), np.uint8)
    pixels[:8, :16] = 255  # white top left, as shown
    undo = {  # how a camera that is held so stores the picture
        1: pixels,
        2: pixels[:, ::-1],
        3: pixels[::-1, ::-1],
        4: pixels[::-1],
        5: pixels.transpose(1, 0, 2),
        6: pixels.transpose(1, 0, 2)[::-1],
        7: pixels[::-1, ::-1].transpose(1, 0, 2),
        8: pixels.transpose(1, 0, 2)[:, ::-1],
    }[orientation]
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.ascontiguousarray(undo)).save(tmp_path / "x.jpg", exif=exif, quality=100)
    read = image.load(tmp_path / "x.jpg").image
    assert read.shape == (3, 16, 32)
    assert np.abs(read.permute(1, 2, 0).numpy() - pixels / 255).max() < 0.05


def test_orientation_of_sixteen_bit_colour(tmp_path: Path) -> None:
    pixels = levels(5, 7, 3, bits=16)
    exif = Image.Exif()
    exif[0x0112] = 6
    image.save(tmp_path / "x.png", from_levels(pixels), bits=16)
    data = (tmp_path / "x.png").read_bytes()
    (tmp_path / "x.png").write_bytes(data[:33] + chunk(b"eXIf", exif.tobytes()[6:]) + data[33:])
    turned = image.load(tmp_path / "x.png").image
    assert np.array_equal(as_levels(turned, 16), np.rot90(pixels, -1))


def from_levels(pixels: np.ndarray) -> Tensor:
    return torch.from_numpy(pixels / 65535.0).permute(2, 0, 1)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def paeth_png(pixels: np.ndarray, *extra: bytes) -> bytes:
    """A 16-bit PNG whose lines use all five filters in turn."""
    h, w, c = pixels.shape
    rows = pixels.astype(">u2").view(np.uint8).reshape(h, w * c * 2).astype(int)
    body, above = b"", np.zeros(w * c * 2, int)
    for y, row in enumerate(rows):
        left = np.concatenate([np.zeros(c * 2, int), row[: -c * 2]])
        corner = np.concatenate([np.zeros(c * 2, int), above[: -c * 2]])
        guess = left + above - corner
        near = [abs(guess - left), abs(guess - above), abs(guess - corner)]
        paeth = np.where(
            (near[0] <= near[1]) & (near[0] <= near[2]),
            left,
            np.where(near[1] <= near[2], above, corner),
        )
        predicted = [0 * row, left, above, (left + above) // 2, paeth][y % 5]
        body += bytes([y % 5]) + ((row - predicted) % 256).astype(np.uint8).tobytes()
        above = row
    header = struct.pack(">IIBBBBB", w, h, 16, {1: 0, 2: 4, 3: 2, 4: 6}[c], 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        [chunk(b"IHDR", header), *extra, chunk(b"IDAT", zlib.compress(body)), chunk(b"IEND", b"")]
    )


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bit_png_keeps_all_bits(tmp_path: Path, channels: int) -> None:
    pixels = levels(11, 7, channels, bits=16)
    (tmp_path / "x.png").write_bytes(paeth_png(pixels))
    picture = image.load(tmp_path / "x.png")
    colours = channels - (channels in (2, 4))
    assert np.array_equal(as_levels(picture.image, 16), pixels[..., :colours])
    assert (picture.mask is None) == (colours == channels)
    if picture.mask is not None:
        assert np.array_equal(picture.mask.numpy(), pixels[..., -1] > 32767)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_transparent_sixteen_bit_colour_is_a_mask(tmp_path: Path, channels: int) -> None:
    pixels = levels(11, 7, channels, bits=16)
    pixels[3, 4] = pixels[6, 2]
    key = pixels[3, 4].astype(">u2").tobytes()
    (tmp_path / "x.png").write_bytes(paeth_png(pixels, chunk(b"tRNS", key)))
    mask = image.load(tmp_path / "x.png").mask
    assert mask is not None
    assert np.argwhere(~mask.numpy()).tolist() == [[3, 4], [6, 2]]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("deflate", [False, True])
def test_sixteen_bit_tiff_keeps_all_bits(
    tmp_path: Path, deflate: bool, channels: int, order: str
) -> None:
    pixels = levels(11, 7, channels, bits=16)
    (tmp_path / "x.tif").write_bytes(tiff16(pixels, order, deflate=deflate))
    picture = image.load(tmp_path / "x.tif")
    assert np.array_equal(as_levels(picture.image, 16), pixels[..., :3])
    if channels == 4:
        assert picture.mask is not None
        assert np.array_equal(picture.mask.numpy(), pixels[..., -1] > 32767)


def tiff16(
    pixels: np.ndarray,
    order: str,
    *,
    planar: int = 1,
    deflate: bool = False,
    white_is_zero: bool = False,
) -> bytes:
    """A 16-bit TIFF of one strip (or, with planar=2, one for each channel)."""
    h, w, c = pixels.shape
    strips = [pixels] if planar == 1 else [pixels[..., i] for i in range(c)]
    bodies = [strip.astype(f"{order}u2").tobytes() for strip in strips]
    bodies = [zlib.compress(body) for body in bodies] if deflate else bodies
    short, long = 3, 4
    tags: list[tuple[int, int, list[int]]] = [
        (256, long, [w]),
        (257, long, [h]),
        (258, short, [16] * c),
        (259, short, [8 if deflate else 1]),
        (262, short, [2 if c > 1 else 0 if white_is_zero else 1]),
        (273, long, []),
        (277, short, [c]),
        (278, long, [h]),
        (279, long, [len(body) for body in bodies]),
        (284, short, [planar]),
    ] + ([(338, short, [2])] if c == 4 else [])
    start = 8 + 2 + 12 * len(tags) + 4
    offsets = [start + sum(len(b) for b in bodies[:i]) for i in range(len(bodies))]
    tail = start + sum(len(body) for body in bodies)
    entries, extra = b"", b""
    for tag, kind, values in tags:
        values = offsets if tag == 273 else values
        packed = struct.pack(f"{order}{len(values)}{'H' if kind == short else 'I'}", *values)
        if len(packed) > 4:
            place = struct.pack(f"{order}I", tail + len(extra))
            extra += packed
        else:
            place = packed.ljust(4, b"\0")
        entries += struct.pack(f"{order}HHI", tag, kind, len(values)) + place
    head = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HI", 42, 8)
    directory = struct.pack(f"{order}H", len(tags)) + entries + struct.pack(f"{order}I", 0)
    return head + directory + b"".join(bodies) + extra


def test_float_tiff_keeps_its_values(tmp_path: Path) -> None:
    values = (noise(9, 7).numpy() * 10 - 5).astype(np.float32)
    Image.fromarray(values).save(tmp_path / "x.tif")
    assert np.array_equal(image.load(tmp_path / "x.tif").image[0].numpy(), values)
    values[2, 3] = np.nan
    values[4, 5] = np.inf
    Image.fromarray(values).save(tmp_path / "x.tif")
    with pytest.raises(ValueError, match=r"exemplar='.*x.tif' holds NaN or infinity at 2 pixels"):
        image.load(tmp_path / "x.tif", name="exemplar")


def bad_files(folder: Path) -> dict[str, str]:
    """File name to a piece of the sentence that refuses it."""
    rng_pixels = levels(32, 32, 3)
    good = folder / "good.png"
    Image.fromarray(rng_pixels).save(good)
    data = good.read_bytes()
    (folder / "truncated.png").write_bytes(data[: len(data) // 2])
    (folder / "header.png").write_bytes(data[:20])
    broken = bytearray(data)
    broken[60:90] = bytes(30)
    (folder / "broken.png").write_bytes(bytes(broken))
    Image.fromarray(rng_pixels).save(folder / "good.jpg")
    (folder / "truncated.jpg").write_bytes((folder / "good.jpg").read_bytes()[:-300])
    (folder / "text.png").write_text("I am no picture")
    (folder / "empty.png").write_bytes(b"")
    (folder / "drawing.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg'/>")
    (folder / "folder.png").mkdir()
    frames = [Image.fromarray(levels(8, 8, 3, seed=seed)) for seed in range(3)]
    for name in ("moving.gif", "moving.png", "pages.tif", "moving.webp"):
        frames[0].save(folder / name, save_all=True, append_images=frames[1:])
    whole = np.arange(12, dtype=np.int32).reshape(3, 4)
    Image.fromarray(whole).save(folder / "int32.tif")
    deep = levels(8, 8, 3, bits=16)
    (folder / "planes.tif").write_bytes(tiff16(deep, "<", planar=2))
    (folder / "packed.tif").write_bytes(tiff16(deep, ">", planar=2, deflate=True))
    (folder / "white.tif").write_bytes(tiff16(deep[..., :1], "<", white_is_zero=True))
    huge = struct.pack(">IIBBBBB", 60000, 60000, 8, 0, 0, 0, 0)
    (folder / "huge.png").write_bytes(data[:8] + chunk(b"IHDR", huge) + data[33:])
    large = struct.pack(">IIBBBBB", 10000, 10000, 8, 0, 0, 0, 0)
    (folder / "large.png").write_bytes(data[:8] + chunk(b"IHDR", large) + data[33:])
    return {
        "missing.png": "there is no such file",
        "good.png/inside.png": "cannot be read",
        "truncated.png": "damaged or cut short",
        "header.png": "none of the pictures|damaged",
        "broken.png": "damaged or cut short",
        "truncated.jpg": "damaged or cut short",
        "text.png": "none of the pictures that can be read",
        "empty.png": "none of the pictures that can be read",
        "drawing.svg": "none of the pictures that can be read",
        "folder.png": "is a folder",
        "moving.gif": "holds 3 frames",
        "moving.png": "holds 3 frames",
        "moving.webp": "holds 3 frames",
        "pages.tif": "holds 3 frames",
        "int32.tif": "pixel format",
        "planes.tif": "pixel format",
        "packed.tif": "pixel format",
        "white.tif": "pixel format",
        "huge.png": "too many pixels",
        "large.png": "too many pixels",
    }


def test_bad_files_get_one_sentence(tmp_path: Path) -> None:
    for name, reason in bad_files(tmp_path).items():
        with pytest.raises(ValueError, match=reason) as caught:
            image.load(tmp_path / name, name="exemplar")
        sentence = str(caught.value)
        assert sentence.startswith(f"exemplar='{tmp_path / name}'")
        assert "\n" not in sentence
        assert len(sentence) < 300


def test_a_photo_with_an_embedded_preview_is_one_picture(tmp_path: Path) -> None:
    frames = [Image.fromarray(levels(16, 16, 3, seed=seed)) for seed in range(2)]
    frames[0].save(tmp_path / "x.jpg", format="MPO", save_all=True, append_images=frames[1:])
    assert image.load(tmp_path / "x.jpg").image.shape == (3, 16, 16)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=80), st.integers(0, 400))
def test_damage_never_shows_another_error(
    tmp_path_factory: pytest.TempPathFactory, junk: bytes, place: int
) -> None:
    path = tmp_path_factory.mktemp("junk") / "x.png"
    image.save(path, noise(3, 12, 9), bits=16, metadata={"seed": "1"})
    data = path.read_bytes()
    path.write_bytes(data[:place] + junk + data[place + len(junk) :])
    with contextlib.suppress(ValueError):
        image.check_image(image.load(path).image)


# ---------------------------------------------------------------------------------- masks


def test_masks_are_true_where_white(tmp_path: Path) -> None:
    wanted = levels(9, 7) > 127
    Image.fromarray(wanted).save(tmp_path / "bits.png")
    Image.fromarray(np.where(wanted, 200, 40).astype(np.uint8)).save(tmp_path / "grey.png")
    Image.fromarray(wanted[..., None] * np.uint8([255] * 3)).save(tmp_path / "rgb.png")
    for name in ("bits", "grey", "rgb"):
        mask = image.load_mask(tmp_path / f"{name}.png", (9, 7))
        assert mask.dtype == torch.bool
        assert np.array_equal(mask.numpy(), wanted)


def test_bad_masks_get_one_sentence(tmp_path: Path) -> None:
    Image.new("L", (7, 9), 0).save(tmp_path / "black.png")
    with pytest.raises(ValueError, match=r"^mask='.*black.png' is empty"):
        image.load_mask(tmp_path / "black.png", (9, 7))
    with pytest.raises(ValueError, match=r"^guide='.*' has 9 x 7 pixels .* 7 x 9"):
        image.load_mask(tmp_path / "black.png", (7, 9), name="guide")
    with pytest.raises(ValueError, match=r"^mask='.*no.png': there is no such file"):
        image.load_mask(tmp_path / "no.png", (9, 7))


# ---------------------------------------------------------------------------------- writing


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".PNG"])
def test_saved_pictures_come_back(tmp_path: Path, suffix: str, bits: int, channels: int) -> None:
    if suffix == ".tif" and bits == 16 and channels > 1:
        with pytest.raises(ValueError, match=r"bits=16 with . channels .* TIFF; use .png"):
            image.save(tmp_path / "x.tif", noise(channels, 9, 7), bits=16)
        return
    x = noise(channels, 9, 7)
    image.save(tmp_path / f"x{suffix}", x, bits=bits)
    picture = image.load(tmp_path / f"x{suffix}")
    colours = channels - (channels in (2, 4))
    assert (picture.image - x[:colours]).abs().max() <= 0.5001 / (2**bits - 1)
    if picture.mask is not None:
        assert torch.equal(picture.mask, (x[-1] * (2**bits - 1)).round() > (2**bits - 1) / 2)
    assert [file.name for file in tmp_path.iterdir()] == [f"x{suffix}"]


def test_other_readers_agree_on_sixteen_bit_colour(tmp_path: Path) -> None:
    pixels = levels(9, 7, 3, bits=16)
    image.save(tmp_path / "x.png", from_levels(pixels), bits=16)
    with Image.open(tmp_path / "x.png") as picture:
        assert np.array_equal(np.array(picture), pixels >> 8)


@pytest.mark.parametrize("channels", [1, 3])
def test_jpeg_is_close(tmp_path: Path, channels: int) -> None:
    ramp = torch.linspace(0, 1, 32, dtype=torch.float64).expand(channels, 16, 32)
    image.save(tmp_path / "x.jpeg", ramp)
    assert (image.load(tmp_path / "x.jpeg").image - ramp).abs().max() < 0.03


def test_values_are_clipped_and_rounded(tmp_path: Path) -> None:
    x = torch.tensor([[[-1.0, 2.0, 0.4999, 1.6 / 255, 1.4 / 255]]], dtype=torch.float64)
    image.save(tmp_path / "x.png", x.requires_grad_())
    wanted = [0, 255, 127, 2, 1]
    assert as_levels(image.load(tmp_path / "x.png").image).flatten().tolist() == wanted


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
def test_metadata_comes_back(tmp_path: Path, suffix: str, bits: int) -> None:
    text = {"torchtex": json.dumps({"seed": 7, "r": 0.8}), "Title": "Mauer – 壁\nzweite Zeile"}
    if suffix == ".jpg" and bits == 16:
        with pytest.raises(ValueError, match="bits=16"):
            image.save(tmp_path / "x.jpg", noise(1, 9, 7), bits=bits, metadata=text)
        return
    image.save(tmp_path / f"x{suffix}", noise(1, 9, 7), bits=bits, metadata=text)
    assert image.read_metadata(tmp_path / f"x{suffix}") == text
    assert image.load(tmp_path / f"x{suffix}").image.shape == (1, 9, 7)
    image.save(tmp_path / f"x{suffix}", noise(1, 9, 7), bits=bits)
    assert image.read_metadata(tmp_path / f"x{suffix}") == {}


def test_foreign_comments_are_no_metadata(tmp_path: Path) -> None:
    for comment in ("made by hand", "[1, 2]", "\x80"):
        Image.new("L", (8, 8)).save(tmp_path / "x.jpg", comment=comment.encode("latin-1"))
        assert image.read_metadata(tmp_path / "x.jpg") == {}
    with pytest.raises(ValueError, match="there is no such file"):
        image.read_metadata(tmp_path / "no.png")


def test_bad_requests_leave_no_file(tmp_path: Path) -> None:
    x = noise(3, 9, 7)
    nan = x.clone()
    nan[1, 2, 3] = torch.nan
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").write_text("")
    refused = [
        ("x.psd", x, {}, r"out='.*x.psd' must end in .png, .jpg"),
        ("x", x, {}, "must end in"),
        ("no/x.png", x, {}, "there is no folder .*; create it first"),
        ("file/x.png", x, {}, "there is no folder"),
        ("folder.png", x, {}, "is no ordinary file"),
        ("x.png", nan, {}, "image holds NaN or infinity at 1 pixels"),
        ("x.png", x[:, :0], {}, "no pixels"),
        ("x.png", noise(5, 9, 7), {}, "image has 5 channels"),
        ("x.jpg", noise(4, 9, 7), {}, "image has 4 channels, which a JPEG"),
        ("x.png", x, {"bits": 12}, "bits=12 must be 8 or 16"),
        ("x.jpg", x, {"bits": 16}, "bits=16 with 3 channels cannot be saved as JPEG; use .png"),
        ("x.png", x, {"metadata": {"": "x"}}, "1 to 79 ASCII"),
        ("x.png", x, {"metadata": {"a" * 80: "x"}}, "1 to 79 ASCII"),
        ("x.jpg", x, {"metadata": {"a": "x" * 70000}}, "metadata is too long"),
        ("x.jpg", noise(1, 1, 65600), {}, "out='.*x.jpg' was not written"),
    ]
    for name, picture, options, reason in refused:
        with pytest.raises(ValueError, match=reason):
            image.save(tmp_path / name, picture, name="out", **options)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "folder.png"]
    assert not list((tmp_path / "folder.png").iterdir())


@pytest.mark.parametrize("wrong", [KeyboardInterrupt, RuntimeError, OSError(28, "no space")])
def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path, wrong: BaseException) -> None:
    (tmp_path / "x.npz").write_text("old")
    wanted = ValueError if isinstance(wrong, OSError) else wrong
    with pytest.raises(wanted), image.atomic_write(tmp_path / "x.npz") as partial:  # noqa: PT012
        partial.write_text("half")
        raise wrong
    assert (tmp_path / "x.npz").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_atomic_write_replaces_keeps_links_and_the_usual_permissions(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("old")
    (tmp_path / "link.json").symlink_to(tmp_path / "x.json")
    with image.atomic_write(tmp_path / "link.json") as partial:
        assert partial.suffix == ".json"
        assert partial.parent == tmp_path
        partial.write_text("new")
        assert (tmp_path / "x.json").read_text() == "old"
    assert (tmp_path / "x.json").read_text() == "new"
    assert (tmp_path / "link.json").is_symlink()
    (tmp_path / "plain").write_text("")
    assert (tmp_path / "x.json").stat().st_mode == (tmp_path / "plain").stat().st_mode
    with pytest.raises(ValueError, match="was not written"), image.atomic_write(tmp_path / "z"):
        pass  # nothing was written


def test_check_writable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image.check_writable(tmp_path / "x.png", suffixes=image.SUFFIXES)
    image.check_writable(tmp_path / "x.anything")
    with pytest.raises(ValueError, match=r"out='.*x.png' must end in .json$"):
        image.check_writable(tmp_path / "x.png", suffixes=[".json"], name="out")
    with pytest.raises(ValueError, match="no ordinary file"):
        image.check_writable(os.devnull)
    monkeypatch.setattr(os, "access", lambda *_: False)  # chmod does not bind a superuser
    with pytest.raises(ValueError, match="not writable"):
        image.check_writable(tmp_path / "x.png")
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------------------------- tensors


def test_check_image() -> None:
    image.check_image(noise(7, 2, 3))
    for wrong, kind, reason in [
        (noise(4, 5), ValueError, r"exemplar has shape \(4, 5\); an image is \(channels"),
        (noise(0, 4, 5), ValueError, "no pixels"),
        (torch.zeros(3, 4, 5, dtype=torch.uint8), TypeError, "exemplar is torch.uint8; convert"),
        (noise(3, 4, 5) / 0, ValueError, "NaN or infinity at 20 pixels"),
    ]:
        with pytest.raises(kind, match=reason):
            image.check_image(wrong, "exemplar")


def test_luminance() -> None:
    x = noise(3, 6, 5)
    wanted = 0.299 * x[0] + 0.587 * x[1] + 0.114 * x[2]
    assert torch.allclose(image.luminance(x), wanted)
    assert torch.equal(image.luminance(x[:1]), x[0])
    assert torch.allclose(image.luminance(noise(7, 6, 5)), noise(7, 6, 5).mean(0))


@settings(max_examples=30, deadline=None)
@given(*[st.integers(1, 24)] * 4)
def test_resize_keeps_constants_dtype_and_linearity(h: int, w: int, y: int, x: int) -> None:
    a, b = noise(2, h, w), noise(2, h, w, seed=1)
    assert image.resize(a, (y, x)).shape == (2, y, x)
    assert image.resize(a, (y, x)).dtype == torch.float64
    flat = image.resize(torch.full_like(a, 0.3), (y, x))
    assert torch.allclose(flat, torch.full_like(flat, 0.3))
    mixed = image.resize(2 * a - b, (y, x))
    assert torch.allclose(mixed, 2 * image.resize(a, (y, x)) - image.resize(b, (y, x)))


def test_shrinking_does_not_alias_and_growing_is_smooth() -> None:
    rows = torch.arange(64, dtype=torch.float64)
    fine = (0.5 + 0.5 * torch.cos(rows * torch.pi * 0.9)).expand(1, 64, 64)
    assert image.resize(fine, (64, 16))[..., 2:-2].std() < 0.02
    assert image.resize(fine, (64, 16), antialias=False)[..., 2:-2].std() > 0.08
    slow = torch.sin(rows * 0.2)
    grown = image.resize(slow.expand(1, 64, 64), (64, 128))[0, 0]
    exact = torch.sin((torch.arange(128) / 2 - 0.25) * 0.2)
    assert (grown - exact)[8:-8].abs().max() < 1e-3
    assert torch.equal(image.resize(fine, (64, 64)), fine)


def test_resize_is_differentiable() -> None:
    x = noise(1, 6, 5).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: image.resize(x, (4, 7)), x)


def test_pyramid_sizes_and_errors() -> None:
    x = noise(3, 33, 20)
    levels_ = image.pyramid(x, (0.01, 0.25, 0.5, 1.0))
    assert [level.shape[1:] for level in levels_] == [(1, 1), (8, 5), (17, 10), (33, 20)]
    assert torch.equal(levels_[-1], x)
    for scales in ((0.5, 0.0), (float("nan"),)):
        with pytest.raises(ValueError, match="scales="):
            image.pyramid(x, scales)
    with pytest.raises(ValueError, match=r"size=\(0, 4\) must be at least 1 x 1"):
        image.resize(x, (0, 4))


def test_the_examples_run() -> None:
    assert doctest.testmod(image).failed == 0
