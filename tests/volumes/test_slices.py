"""Slices of volumes: which way they lie, planes at an angle, windows and their adjoints."""

import pytest
import torch
from conftest import noise

from torchtex.volumes.slices import PLANES, Windows, diagonal_slice, groups, slices_of


def test_slices_lie_as_the_views_say() -> None:
    volume = noise(2, 4, 5, 6)
    front, above, side = (slices_of(volume, axis) for axis in (0, 1, 2))
    assert torch.equal(front[3], volume[:, 3])
    assert torch.equal(above[2], volume[:, :, 2])
    assert torch.equal(side[1], volume[:, :, :, 1].transpose(1, 2))
    with pytest.raises(ValueError, match="axis=3"):
        slices_of(volume, 3)


def test_a_diagonal_slice_holds_voxels_of_the_diagonal() -> None:
    number = torch.arange(6.0)
    volume = torch.stack(torch.meshgrid(number, number, number, indexing="ij"))
    plane = diagonal_slice(volume, 1, shift=2)
    assert plane.shape == (3, 6, 8)
    assert torch.equal(plane[1], number[:, None].expand(6, 8))
    assert torch.equal((plane[0] + 2) % 6, plane[2])
    steps = (plane[0, 0, 1:] - plane[0, 0, :-1]) % 6
    assert int(steps.max()) == 1
    assert int(steps.min()) >= 0


@pytest.mark.parametrize(
    ("rows", "cols", "stride"), [(8, 8, 4), (9, 14, 3), (11, 8, 8), (16, 12, 1)]
)
def test_scatter_is_the_adjoint_of_gather(rows: int, cols: int, stride: int) -> None:
    windows = Windows(rows, cols, 8, stride, (3, 5))
    slices = noise(3, rows, cols, 2, seed=1)
    gathered = windows.gather(slices)
    patches = noise(*gathered.shape, seed=2)
    left, right = (gathered * patches).sum(), (slices * windows.scatter(patches)).sum()
    assert torch.allclose(left, right)
    assert windows.scatter(torch.ones_like(gathered)).min() >= 1  # every voxel is covered


def test_a_window_begins_where_it_should_and_wraps() -> None:
    windows = Windows(10, 9, 4, 2, (3, 8))
    slices = noise(1, 10, 9, 1)
    first = windows.gather(slices)[0].view(4, 4)
    assert torch.equal(first, slices[0, :, :, 0].roll((-3, -8), (0, 1))[:4, :4])


def test_bad_windows_get_a_sentence() -> None:
    with pytest.raises(ValueError, match="smaller than a window"):
        Windows(7, 9, 8, 4)
    with pytest.raises(ValueError, match="stride=9"):
        Windows(9, 9, 8, 9)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_groups_hold_every_slice_once_and_write_through(axis: int) -> None:
    volume = torch.zeros(9, 10, 11, 1, dtype=torch.float64)
    found = groups((9, 10, 11), axis, 8, 4, torch.tensor([1, 2]))
    for group in found:
        assert (group.windows.rows, group.windows.cols) == tuple(
            (9, 10, 11)[other] for other in PLANES[axis]
        )
        group.of(volume).add_(1)
    assert torch.equal(volume, torch.ones_like(volume))
    assert len({group.windows.offset for group in found}) == 4
