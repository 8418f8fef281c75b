"""Flow files: written and read again, and what is wrong with bad ones."""

import doctest
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import noise

from torchtex.flow import files
from torchtex.flow.files import load_flow, load_strokes, save_flow


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(2, 5, 4), (3, 2, 5, 4)])
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_arrays_come_back_as_they_were(
    tmp_path: Path, suffix: str, shape: tuple[int, ...], dtype: torch.dtype
) -> None:
    fields = noise(*shape, dtype=dtype)
    save_flow(tmp_path / f"flow{suffix}", fields)
    found = load_flow(tmp_path / f"flow{suffix}", loop=True)
    assert torch.equal(found.fields, fields)
    assert found.fields.dtype == dtype
    assert found.loop


def test_flo_files_are_those_of_middlebury(tmp_path: Path) -> None:
    path = tmp_path / "two.flo"
    # 1 row, 2 columns: u = x = column first, then v = y = row
    path.write_bytes(b"PIEH" + struct.pack("<ii4f", 2, 1, 0.5, 0.25, -1.0, 0.75))
    fields = load_flow(path).fields
    assert fields.tolist() == [[[0.25, 0.75]], [[0.5, -1.0]]]
    save_flow(tmp_path / "again.flo", fields.double()[None])
    assert (tmp_path / "again.flo").read_bytes() == path.read_bytes()


def test_integers_and_other_byte_orders_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ones((2, 3, 3), np.int16))
    assert load_flow(tmp_path / "a.npy").fields.dtype == torch.float64
    np.save(tmp_path / "b.npy", np.ones((2, 3, 3), ">f4"))
    assert load_flow(tmp_path / "b.npy").fields.dtype == torch.float32
    np.savez(tmp_path / "c.npz", other=np.zeros(3), flow=np.ones((2, 3, 3)))
    assert load_flow(tmp_path / "c.npz").fields.shape == (2, 3, 3)


@pytest.mark.parametrize(
    ("array", "says"),
    [
        (np.full((2, 3, 3), np.nan), "NaN or infinity at 9 pixels"),
        (np.zeros((3, 3)), r"shape \(3, 3\) must be"),
        (np.zeros((3, 3, 2)), r"shape \(3, 3, 2\) must be"),
        (np.zeros((0, 2, 3, 3)), "has no frames"),
        (np.full((2, 3, 3), 3.5), r"a pixel moves by 3\.5, more than the height of 3"),
        (np.array(["a"]), "damaged or no flow"),
        (np.array([{}]), "damaged or no flow"),
        (np.zeros((2, 3, 3), complex), "damaged or no flow"),
    ],
)
def test_arrays_that_are_no_flow_are_refused(tmp_path: Path, array: object, says: str) -> None:
    path = tmp_path / "bad.npy"
    np.save(path, array, allow_pickle=True)
    with pytest.raises(ValueError, match=says) as error:
        load_flow(path)
    assert str(error.value).startswith(f"flow={str(path)!r}")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "does not begin like"),
        (b"PIEH" + struct.pack("<ii", 2, 1), "cut short or damaged"),
        (b"PIEH" + struct.pack("<ii4f", 2, 1, 0, 0, 0, 0)[:-1], "cut short or damaged"),
        (b"PIEH" + struct.pack("<ii", 2**30, 2**30), "cut short or damaged"),
        (b"PIEH" + struct.pack("<ii", 0, 4), "needs at least one"),
        (b"HEIP" + struct.pack("<ii2f", 1, 1, 0, 0), "does not begin like"),
        (b"PIEH" + struct.pack("<ii2f", 1, 1, 1.7e9, 0), "does not know the flow of 1 pixels"),
        (b"PIEH" + struct.pack("<ii2f", 1, 1, float("nan"), 0), "NaN or infinity at 1 pixels"),
    ],
)
def test_bad_flo_files_are_refused(tmp_path: Path, data: bytes, says: str) -> None:
    path = tmp_path / "bad.flo"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=says):
        load_flow(path)


def test_bad_files_are_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no such file"):
        load_flow(tmp_path / "none.npy")
    with pytest.raises(ValueError, match=r"must end in \.npy, \.npz or \.flo"):
        load_flow(tmp_path / "flow.txt")
    (tmp_path / "folder.npy").mkdir()
    with pytest.raises(ValueError, match="cannot be read"):
        load_flow(tmp_path / "folder.npy")
    for suffix in (".npy", ".npz"):
        path = tmp_path / f"cut{suffix}"
        save_flow(path, noise(2, 8, 8))
        path.write_bytes(path.read_bytes()[:150])
        with pytest.raises(ValueError, match="damaged or no flow"):
            load_flow(path)
        path.write_bytes(b"")
        with pytest.raises(ValueError, match="damaged or no flow"):
            load_flow(path)
    np.savez(tmp_path / "two.npz", a=np.zeros(3), b=np.zeros(3))
    with pytest.raises(ValueError, match="none of them is called flow"):
        load_flow(tmp_path / "two.npz")
    with pytest.raises(ValueError, match="NaN or infinity"):
        save_flow(tmp_path / "a.npy", torch.full((2, 3, 3), torch.nan))
    with pytest.raises(ValueError, match="there are 3"):
        save_flow(tmp_path / "a.flo", noise(3, 2, 4, 4))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "cannot be read as JSON"),
        ("3", "must hold lines"),
        ("{}", "must hold lines"),
        ("[[1, 2]]", "must hold lines"),
        ('[[["a", 2], [1, 2]]]', "must hold lines"),
        ("[[[1, 2, 3]]]", "must hold lines"),
    ],
)
def test_bad_strokes_are_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=says):
        load_strokes(path)


def test_strokes_may_be_in_an_object(tmp_path: Path) -> None:
    path = tmp_path / "good.json"
    path.write_text('{"strokes": [[[0.9, 0.5], [0.1, 0.5], [0, 0]]], "note": "up"}')
    assert load_strokes(path) == (((0.9, 0.5), (0.1, 0.5), (0.0, 0.0)),)


def test_examples() -> None:
    assert doctest.testmod(files, extraglobs={"torch": torch}).failed == 0
