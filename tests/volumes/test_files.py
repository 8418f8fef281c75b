"""Volume files: what is written comes back, files of others are read, sentences for bad ones."""

import base64
import gzip
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import noise

from torchtex.volumes.files import check_volume_path, load_volume, save_volume

NAMES = ("v.npy", "v.nrrd", "v.vti", "v.zarr", "slices")


def solid(channels: int = 3) -> torch.Tensor:
    """A volume whose axes all differ in length."""
    return noise(channels, 4, 6, 5, seed=channels)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("name", NAMES)
def test_what_is_written_comes_back_in_8_bits(name: str, channels: int, tmp_path: Path) -> None:
    if name == "v.zarr":
        pytest.importorskip("zarr", reason="zarr is not installed")
    if name == "slices" and channels == 4:
        pytest.skip("pictures hold 1 or 3 channels")
    volume = solid(channels)
    save_volume(tmp_path / name, volume)
    again = load_volume(tmp_path / name)
    assert again.dtype == torch.float32
    assert torch.allclose(again.double() * 255, (volume * 255).round(), atol=1e-4)
    save_volume(tmp_path / name, again)  # over the old one
    assert torch.equal(load_volume(tmp_path / name), again)
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", NAMES)
def test_more_bits(name: str, tmp_path: Path) -> None:
    if name == "v.zarr":
        pytest.importorskip("zarr", reason="zarr is not installed")
    volume = solid()
    save_volume(tmp_path / name, volume, bits=16)
    assert (load_volume(tmp_path / name).double() - volume).abs().max() < 1e-5
    if name != "slices":
        save_volume(tmp_path / name, volume, bits=32)
        assert torch.equal(load_volume(tmp_path / name), volume.float())


def test_arrays_of_other_programs(tmp_path: Path) -> None:
    volume = (solid() * 255).round().to(torch.uint8).numpy()
    wanted = torch.from_numpy(volume) / 255
    last = np.ascontiguousarray(volume.transpose(1, 2, 3, 0))
    np.save(tmp_path / "last.npy", np.concatenate([last, last]))
    assert torch.equal(load_volume(tmp_path / "last.npy"), torch.cat([wanted, wanted], 1))
    np.save(tmp_path / "grey.npy", volume[0])
    assert torch.equal(load_volume(tmp_path / "grey.npy"), wanted[:1])
    sizes = b"NRRD0005\n# a comment\ntype: uint8\ndimension: 4\nsizes: 5 6 4 3\n"
    kinds = b"kinds: domain domain domain RGB-color\nencoding: gzip\nnote:=x\n\n"
    (tmp_path / "planes.nrrd").write_bytes(sizes + kinds + gzip.compress(volume.tobytes()))
    assert torch.equal(load_volume(tmp_path / "planes.nrrd"), wanted)
    big = volume[0].astype(">u2") * 257
    head = b"NRRD0001\r\ntype: ushort\r\ndimension: 3\r\nsizes: 5 6 4\r\n"
    head += b"endian: big\r\nencoding: raw\r\n\r\n"
    (tmp_path / "big.nrrd").write_bytes(head + big.tobytes())
    assert torch.allclose(load_volume(tmp_path / "big.nrrd"), wanted[:1])


@pytest.mark.parametrize("place", ["PointData", "CellData"])
def test_base64_of_other_programs(place: str, tmp_path: Path) -> None:
    volume = (solid(1) * 255).round().to(torch.uint8).numpy()[0]
    extent = "0 4 0 5 0 3" if place == "PointData" else "0 5 0 6 0 4"
    data = base64.b64encode(np.array(volume.size, "<u4").tobytes() + volume.tobytes()).decode()
    around = (
        '<VTKFile type="ImageData" version="0.1" byte_order="LittleEndian">'
        f'<ImageData WholeExtent="{extent}"><Piece Extent="{extent}"><{place}>'
        '<DataArray type="UInt8" %s</DataArray>'
        f"</{place}></Piece></ImageData>%s</VTKFile>"
    )
    text = around % (f'format="binary">\n{data}\n', "")
    (tmp_path / "inline.vti").write_text(text)
    appended = f'<AppendedData encoding="base64">\n_{data}\n</AppendedData>'
    (tmp_path / "appended.vti").write_text(around % ('format="appended" offset="0">', appended))
    for name in ("inline.vti", "appended.vti"):
        assert torch.equal(load_volume(tmp_path / name), torch.from_numpy(volume)[None] / 255)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("v.obj", b"x", "must end in"),
        ("none.npy", None, "no such file"),
        ("text.npy", b"hello", "cannot be read"),
        ("empty.npy", b"", "cannot be read"),
        ("short.nrrd", b"NRRD0004\ntype: uint8\nsizes: 1 9 9 9\nencoding: raw\n\nxx", "it says"),
        ("odd.nrrd", b"NRRD0004\ntype: block\nsizes: 1 9 9 9\nencoding: raw\n\nxx", "block"),
        ("hex.nrrd", b"NRRD0004\ntype: uint8\nsizes: 1 1 1\nencoding: hex\n\nxx", "encoding"),
        ("no.nrrd", b"hello", "header"),
        ("no.vti", b"hello", "cannot be read"),
        ("poly.vti", b'<VTKFile type="PolyData"></VTKFile>', "ImageData"),
    ],
)
def test_bad_files_get_a_sentence(
    name: str, content: bytes | None, words: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=words) as caught:
        load_volume(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_bad_arrays_and_folders_get_a_sentence(tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", np.zeros((4, 4)))
    np.save(tmp_path / "signed.npy", np.zeros((4, 4, 4), np.int32))
    np.save(tmp_path / "nan.npy", np.full((4, 4, 4), np.nan))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thing.txt").write_text("mine")
    for name in ("flat.npy", "signed.npy", "nan.npy", "other"):
        with pytest.raises(ValueError, match=r"cannot be read|NaN|without pictures"):
            load_volume(tmp_path / name)
    with pytest.raises(ValueError, match="other things"):
        save_volume(tmp_path / "other", solid())
    assert (tmp_path / "other" / "thing.txt").exists()


@pytest.mark.parametrize("name", ["stuff", "stuff.zarr"])
@pytest.mark.parametrize("meta", ["zarr.json", ".zarray"])
def test_a_folder_with_files_of_others_is_never_replaced(
    name: str, meta: str, tmp_path: Path
) -> None:
    folder = tmp_path / name
    (folder / "c").mkdir(parents=True)
    (folder / meta).write_text('{"node_type": "array"}')
    thesis = folder / ("c" if meta == "zarr.json" else "") / "thesis.tex"
    thesis.write_text("years")
    with pytest.raises(ValueError, match="other things"):
        save_volume(folder, solid())
    assert thesis.read_text() == "years"


@pytest.mark.parametrize("version", [2, 3])
def test_a_zarr_array_is_replaced_and_a_group_is_not(version: int, tmp_path: Path) -> None:
    zarr = pytest.importorskip("zarr", reason="zarr is not installed")
    array = {"shape": (4, 4, 4), "chunks": (2, 4, 4), "dtype": "u1", "zarr_format": version}
    zarr.open_array(str(tmp_path / "one.zarr"), mode="w", **array)[...] = 1
    (tmp_path / "same").symlink_to(tmp_path / "one.zarr")
    with pytest.raises(ValueError, match="other things"):
        save_volume(tmp_path / "same", solid())  # no ending: a folder of slices
    save_volume(tmp_path / "one.zarr", solid())
    assert load_volume(tmp_path / "one.zarr").shape == (3, 4, 6, 5)
    group = zarr.open_group(str(tmp_path / "more.zarr"), mode="w", zarr_format=version)
    group.create_array("0", shape=(4,), dtype="u1")[...] = 7
    for path in ("more.zarr", "more.zarr/no.zarr"):
        (tmp_path / "more.zarr" / "no.zarr").mkdir(exist_ok=True)
        (tmp_path / "more.zarr" / "no.zarr" / "zarr.json").write_text("no json")
        with pytest.raises(ValueError, match="other things"):
            save_volume(tmp_path / path, solid())
    assert group["0"][:].tolist() == [7] * 4


def test_the_old_folder_comes_back_after_an_interrupt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_volume(tmp_path / "slices", solid())
    before, usual = load_volume(tmp_path / "slices"), Path.rename

    def rename(path: Path, target: Path) -> Path:
        if target.name == "slices" and not path.name.endswith(".old"):
            raise KeyboardInterrupt
        return usual(path, target)

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(KeyboardInterrupt):
        save_volume(tmp_path / "slices", 1 - solid())
    assert torch.equal(load_volume(tmp_path / "slices"), before)
    assert [path.name for path in tmp_path.iterdir()] == ["slices"]


def test_nothing_half_written_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_volume(tmp_path / "slices", solid())
    before = load_volume(tmp_path / "slices")

    def full(*arguments: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(ValueError, match="not written"):
            save_volume(tmp_path / "slices", 1 - solid())
    assert torch.equal(load_volume(tmp_path / "slices"), before)
    assert [path.name for path in tmp_path.iterdir()] == ["slices"]


def test_names_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for path, bits, channels, words in (
        (tmp_path / "v.stl", 8, 3, "must end in"),
        (tmp_path / "v.npy", 12, 3, "bits=12"),
        (tmp_path / "slices", 32, 3, r"pictures hold .* name a .npy, .nrrd, .vti or .zarr"),
        (tmp_path / "slices", 8, 7, "pictures hold"),
        (tmp_path / "file", 8, 3, "is a file"),
        (tmp_path / "no" / "v.npy", 8, 3, "no folder"),
        (tmp_path / "no" / "slices", 8, 3, "no folder"),
    ):
        with pytest.raises(ValueError, match=words):
            check_volume_path(path, bits=bits, channels=channels)
