"""Windows: adjoint, coverage, bands, fall-off."""

import doctest

import pytest
import torch
from conftest import noise
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from torchtex import neighborhoods
from torchtex.neighborhoods import Grid, Neighborhoods, falloff, site_positions

GRIDS = {
    "height": st.integers(1, 21),
    "width": st.integers(1, 21),
    "size": st.integers(1, 9),
    "stride": st.integers(1, 9),
    "periodic": st.booleans(),
}


def grid_of(height: int, width: int, size: int, stride: int, periodic: bool) -> Grid:
    assume(stride <= size <= min(height, width))
    return Grid(height, width, size, stride, periodic)


@settings(max_examples=60, deadline=None)
@given(**GRIDS, channels=st.integers(1, 5))
def test_scatter_is_the_adjoint_of_gather(
    height: int, width: int, size: int, stride: int, periodic: bool, channels: int
) -> None:
    grid = grid_of(height, width, size, stride, periodic)
    x = noise(channels, height, width, seed=1)
    windows = grid.gather(x)
    assert windows.shape == (len(grid), size * size * channels)
    p = noise(*windows.shape, seed=2)
    torch.testing.assert_close((windows * p).sum(), (x * grid.scatter(p)).sum())


@settings(max_examples=60, deadline=None)
@given(**GRIDS, most=st.integers(1, 40))
def test_bands_together_are_the_whole(
    height: int, width: int, size: int, stride: int, periodic: bool, most: int
) -> None:
    grid = grid_of(height, width, size, stride, periodic)
    x = noise(2, height, width)
    bands = grid.bands(most)
    parts = [grid.gather(x, band) for band in bands]
    assert torch.equal(torch.cat(parts), grid.gather(x))
    assert all(len(part) <= max(most, grid.shape[1]) for part in parts)
    summed = sum(grid.scatter(part, band) for part, band in zip(parts, bands, strict=True))
    torch.testing.assert_close(summed, grid.scatter(grid.gather(x)))


@settings(max_examples=60, deadline=None)
@given(**GRIDS)
def test_every_pixel_is_covered_and_sites_are_at_most_a_stride_apart(
    height: int, width: int, size: int, stride: int, periodic: bool
) -> None:
    grid = grid_of(height, width, size, stride, periodic)
    cover = grid.scatter(grid.gather(torch.ones(1, height, width, dtype=torch.float64)))
    assert cover.min() >= 1
    assert len(grid.sites) == len(grid) == grid.shape[0] * grid.shape[1]
    for places, extent in ((grid.rows, height), (grid.cols, width)):
        assert places[0] == 0
        assert places.unique().equal(places)
        if periodic:
            assert places.diff(append=torch.tensor([extent])).max() <= stride
        else:
            assert places[-1] == extent - size
            assert not len(places.diff()) or places.diff().max() <= stride


@pytest.mark.parametrize("periodic", [False, True])
def test_a_window_lists_rows_then_columns_then_channels(periodic: bool) -> None:
    grid = Grid(11, 9, 4, 3, periodic)
    x = noise(2, 11, 9)
    windows = grid.gather(x).view(-1, 4, 4, 2)
    for window, (row, col) in zip(windows, grid.sites.tolist(), strict=True):
        rows, cols = (row + torch.arange(4)) % 11, (col + torch.arange(4)) % 9
        assert torch.equal(window.permute(2, 0, 1), x[:, rows[:, None], cols])


def test_periodic_windows_follow_a_rolled_image() -> None:
    grid = Grid(12, 12, 5, 3, periodic=True)
    x = noise(1, 12, 12)
    rolled = grid.gather(x.roll((3, 3), (1, 2))).view(4, 4, -1)
    assert torch.equal(rolled, grid.gather(x).view(4, 4, -1).roll((1, 1), (0, 1)))


def test_one_window_may_be_the_whole_image() -> None:
    grid = Grid(6, 6, 6, 6)
    x = noise(3, 6, 6)
    assert len(grid) == 1
    assert torch.equal(grid.scatter(grid.gather(x)), x)
    assert site_positions(6, 6, 1).tolist() == [0]


def test_grid_is_a_neighborhoods() -> None:
    assert isinstance(Grid(8, 8, 4, 2), Neighborhoods)


@pytest.mark.parametrize("size", [1, 2, 7, 8])
def test_falloff_is_a_symmetric_bump_of_mean_one(size: int) -> None:
    weights = falloff(size)
    assert weights.dtype == torch.float64
    torch.testing.assert_close(weights.mean(), torch.ones((), dtype=torch.float64))
    torch.testing.assert_close(weights, weights.flip(0))
    torch.testing.assert_close(weights, weights.T)
    assert weights.min() > 0
    assert weights[(size - 1) // 2, (size - 1) // 2] == weights.max()
    profile = falloff(size, sigma=2.0)[0]
    if size > 1:
        expected = torch.exp(torch.tensor(-0.125 * (((size - 1) / 2) ** 2 - ((size - 3) / 2) ** 2)))
        torch.testing.assert_close(profile[0] / profile[1], expected.double())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((8, 8, 4, 5), r"stride=5 must lie in 1\.\.size=4"),
        ((8, 8, 4, 0), r"stride=0 must lie in 1\.\.size=4"),
        ((3, 8, 4, 2), "height=3 is smaller than a window of size=4"),
        ((8, 3, 4, 2), "width=3 is smaller than a window of size=4"),
    ],
)
def test_a_grid_that_does_not_fit_says_why(
    options: tuple[int, int, int, int], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Grid(*options)


def test_the_examples_run() -> None:
    assert doctest.testmod(neighborhoods).failed == 0
