"""Inversion, warps and confidence on flows whose answer is known."""

import doctest

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex.flow import warps
from torchtex.flow.fields import Flow, Uniform
from torchtex.flow.fluids import StableFluid
from torchtex.flow.formulas import Rotation, Saddle, Shear, Sink, Source
from torchtex.flow.vortices import Vortices, vortex_pair
from torchtex.flow.warps import advect, coverage, divergence, invert, jacobian, sample, warp
from torchtex.quadratic import threads

SMOOTH: list[Flow] = [
    Rotation(5.0), Rotation(60.0), Vortices((3.0,)), vortex_pair(), Saddle(), Shear(), Source(),
    Sink(), StableFluid(seed=4), Uniform((0.3, -1.7)),
]  # fmt: skip


def places(height: int, width: int) -> Tensor:
    rows, columns = torch.arange(height).double(), torch.arange(width).double()
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"))


def smooth(side: int) -> Tensor:
    row, column = places(side, side)
    return torch.stack([torch.sin(0.2 * row + 0.1 * column), torch.cos(0.15 * column)])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("cubic", [False, True])
@pytest.mark.parametrize("shift", [(3, -2), (0, 5), (-7, 0)])
def test_whole_shifts_are_exact(shift: tuple[int, int], cubic: bool, dtype: torch.dtype) -> None:
    image = noise(3, 37, 41, dtype=dtype)
    field = Uniform((float(shift[0]), float(shift[1])))(0, 37, 41).to(dtype)
    moved, trust = advect(image, field, periodic=True, cubic=cubic)
    wanted = image.roll(shift, (1, 2))
    assert moved.dtype == trust.dtype == dtype
    if dtype == torch.float32:
        assert torch.equal(moved, wanted)
    torch.testing.assert_close(moved, wanted, rtol=0, atol=1e-12)
    assert trust.min() > 1 - 1e-6


def test_what_comes_from_outside_is_not_trusted() -> None:
    image = noise(3, 20, 22)
    moved, trust = advect(image, Uniform((3.0, 0.0))(0, 20, 22))
    torch.testing.assert_close(moved[:, 3:], image[:, :-3], rtol=0, atol=1e-12)
    assert trust[:3].max() == 0
    torch.testing.assert_close(trust[3:], torch.ones(17, 22).double())
    half = advect(image, Uniform((0.5, 0.0))(0, 20, 22))[1]
    assert half[0].min() == pytest.approx(0.5)


@pytest.mark.parametrize("flow", SMOOTH, ids=repr)
def test_there_and_back_is_where_it_was(flow: Flow) -> None:
    field = flow(9, 48, 40)
    backward, trust = invert(field)
    assert backward.dtype == field.dtype
    assert trust.min() >= 0
    assert trust.max() <= 1
    source = places(48, 40) + backward
    landed = source + sample(field, source, cubic=False)
    inside = trust > 0.5
    assert inside.float().mean() > 0.4
    torch.testing.assert_close(landed[:, inside], places(48, 40)[:, inside], rtol=0, atol=1e-4)


def test_a_rotation_is_undone_by_the_opposite_one() -> None:
    backward, trust = invert(Rotation(5.0)(0, 64, 64))
    inside = slice(12, 52)
    wanted = Rotation(-5.0)(0, 64, 64)
    torch.testing.assert_close(backward[:, inside, inside], wanted[:, inside, inside])
    assert trust[inside, inside].min() > 1 - 1e-6
    image = smooth(64)
    forth, _ = advect(image, Rotation(5.0)(0, 64, 64))
    back, _ = advect(forth, Rotation(-5.0)(0, 64, 64))
    assert (back - image)[:, inside, inside].abs().max() < 2e-3


def test_the_corners_of_a_rotation_come_from_outside() -> None:
    trust = invert(Rotation(20.0)(0, 64, 64))[1]
    assert trust[32, 32] > 0.99
    assert max(trust[0, 0], trust[0, -1], trust[-1, 0], trust[-1, -1]) == 0


def test_new_pixels_of_a_source_are_in_the_middle() -> None:
    trust = invert(Source(1.5, core=0.1)(0, 65, 65))[1]
    assert trust.argmin() == 32 * 65 + 32
    assert trust[32, 32] < 0.75
    assert trust[4, 4] > 0.95
    squeezed = invert(Sink(1.5, core=0.1)(0, 65, 65))[1]
    assert squeezed[32, 32] < 0.75
    assert squeezed[10, 10] > 0.9
    assert squeezed[0].max() == 0  # comes from outside


def test_nothing_lands_in_a_gap_that_opens() -> None:
    field = torch.zeros(2, 20, 30, dtype=torch.float64)
    field[1, :, 15:] = 5.0  # the right half moves away
    trust = invert(field)[1]
    assert coverage(field)[:, 15:20].max() == 0
    assert trust[:, 15:20].max() == 0
    assert trust[:, :14].min() > 1 - 1e-6
    assert trust[:, 21:].min() > 1 - 1e-6


def test_what_is_run_over_is_not_trusted() -> None:
    field = torch.zeros(2, 20, 30, dtype=torch.float64)
    field[1, :, :15] = 5.0  # the left half runs over the right one
    trust = invert(field)[1]
    assert trust[:, 22:].min() > 1 - 1e-6
    assert trust[:, 6:13].min() > 1 - 1e-6
    assert trust[:, 15:19].min() < 1


def test_coverage_counts_every_pixel_once() -> None:
    field = StableFluid(seed=1, periodic=True)(3, 24, 20)
    count = coverage(field, periodic=True)
    assert float(count.sum()) == pytest.approx(24 * 20, abs=1e-3)
    assert coverage(torch.zeros(2, 3, 4)).tolist() == torch.ones(3, 4).tolist()


def test_derivatives_of_linear_fields() -> None:
    row, column = places(6, 8)
    field = torch.stack([0.1 * row + 0.2 * column, 0.3 * column - 0.4 * row])
    torch.testing.assert_close(divergence(field), torch.full((6, 8), 0.4).double())
    wanted = torch.tensor([[1.1, 0.2], [-0.4, 1.3]]).double()
    jac = jacobian(field).permute(2, 3, 0, 1)
    torch.testing.assert_close(jac, wanted.expand(6, 8, 2, 2), rtol=0, atol=1e-7)
    assert divergence(torch.ones(2, 1, 1)).item() == 0  # a single pixel has no slope


def test_tiles_are_read_across_the_edge() -> None:
    image = noise(2, 9, 7)
    place = places(9, 7) + torch.tensor([90.0, -70.0]).double()[:, None, None]
    torch.testing.assert_close(sample(image, place, periodic=True), image, rtol=0, atol=1e-10)
    between = places(9, 7) + 0.5
    mean = (image + image.roll(-1, 1) + image.roll(-1, 2) + image.roll((-1, -1), (1, 2))) / 4
    torch.testing.assert_close(sample(image, between, periodic=True, cubic=False), mean)


def test_cubic_keeps_more_detail_than_linear() -> None:
    image = stripes(32, 32)
    field = Uniform((0.5, 0.5))(0, 32, 32)
    cubic = advect(image, field, periodic=True)[0].std()
    linear = advect(image, field, periodic=True, cubic=False)[0].std()
    assert linear < cubic < image.std()


def test_slopes_are_kept_and_no_frequency_is_amplified() -> None:
    row, column = places(12, 12)
    ramp = (0.3 * row + 0.1 * column + 0.01 * row * row)[None]
    place = places(6, 6) + 3.3
    wanted = 0.3 * place[0] + 0.1 * place[1] + 0.01 * place[0] ** 2
    torch.testing.assert_close(sample(ramp, place)[0], wanted)
    image = noise(1, 32, 32)
    for shift in (0.2, 0.5, 0.7):
        moved = sample(image, places(32, 32) + shift, periodic=True)
        gain = torch.fft.fft2(moved).abs() / torch.fft.fft2(image).abs()
        assert gain.max() < 1 + 1e-9


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("cubic", [False, True])
def test_gradients_of_warps(periodic: bool, cubic: bool) -> None:
    image = noise(2, 5, 6, seed=1).requires_grad_()
    backward = (2.6 * noise(2, 5, 6, seed=2) - 1.3).requires_grad_()

    def function(x: Tensor, b: Tensor) -> Tensor:
        return warp(x, b, periodic=periodic, cubic=cubic)

    assert torch.autograd.gradcheck(function, (image, backward))


@pytest.mark.parametrize("periodic", [False, True])
def test_bits_do_not_depend_on_the_thread_count(periodic: bool) -> None:
    image = noise(3, 150, 160, dtype=torch.float32)
    field = StableFluid(seed=2, periodic=periodic)(1, 150, 160)
    one = advect(image, field, periodic=periodic)
    with threads(2):
        two = advect(image, field, periodic=periodic)
    assert torch.equal(one[0], two[0])
    assert torch.equal(one[1], two[1])


def test_a_single_row_and_a_single_pixel() -> None:
    for size in ((1, 5), (5, 1), (1, 1)):
        image = noise(1, *size)
        for periodic in (False, True):
            moved, trust = advect(image, torch.zeros(2, *size).double(), periodic=periodic)
            torch.testing.assert_close(moved, image)
            assert trust.min() == 1


@pytest.mark.usefixtures("unchecked")
def test_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"field of \(4, 5\) pixels does not fit the image"):
        advect(torch.zeros(3, 5, 5), torch.zeros(2, 4, 5))
    with pytest.raises(ValueError, match="NaN or infinity at 20 pixels"):
        invert(torch.full((2, 4, 5), torch.nan))


def test_examples() -> None:
    assert doctest.testmod(warps, extraglobs={"torch": torch}).failed == 0
