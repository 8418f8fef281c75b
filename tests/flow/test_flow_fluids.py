"""Vortices, the double gyre and the simulated fluid."""

import doctest

import pytest
import torch

from torchtex.flow import fluids
from torchtex.flow.fluids import DoubleGyre, StableFluid
from torchtex.flow.vortices import Vortices, vortex_pair
from torchtex.flow.warps import divergence


@pytest.mark.parametrize("periodic", [False, True])
def test_a_frame_is_the_same_in_any_order(periodic: bool) -> None:
    fluid = StableFluid(seed=3, periodic=periodic, resolution=16)
    forwards = [fluid(frame, 24, 30) for frame in range(40)]
    other = StableFluid(seed=3, periodic=periodic, resolution=16)
    for frame in (39, 20, 0, 21, 5):
        assert torch.equal(other(frame, 24, 30), forwards[frame])
    assert not torch.equal(forwards[20], forwards[21])
    assert not torch.equal(StableFluid(seed=4, resolution=16)(5, 24, 30), forwards[5])


def test_few_states_stay_in_memory() -> None:
    fluid = StableFluid(resolution=8)
    for frame in range(70):
        fluid(frame, 12, 12)
    assert len(fluid._states[(12, 12)]) <= 70 // 16 + 2
    for frame in (65, 3, 40, 7, 22):
        fluid(frame, 12, 12)
    assert len(fluid._states[(12, 12)]) <= 70 // 16 + 2
    for side in range(13, 20):
        fluid(0, side, side)
    assert len(fluid._states) <= 4


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("frame", [0, 30])
def test_a_fluid_keeps_its_speed_and_volume(frame: int, periodic: bool) -> None:
    field = StableFluid(seed=5, speed=1.2, periodic=periodic)(frame, 64, 80)
    assert field.square().sum(0).mean().sqrt() == pytest.approx(1.2, rel=0.05)
    inside = divergence(field, periodic=periodic)[2:-2, 2:-2]
    assert inside.square().mean().sqrt() < 0.03


def test_nothing_passes_the_walls_of_a_box() -> None:
    field = StableFluid(seed=6)(20, 64, 64)
    fastest = field.abs().max()
    walls = (field[0, 0], field[0, -1], field[1, :, 0], field[1, :, -1])
    assert max(float(wall.abs().max()) for wall in walls) < 0.15 * fastest


def test_the_double_gyre_swings_and_comes_back() -> None:
    gyre = DoubleGyre(period=8.0)
    torch.testing.assert_close(gyre(0, 16, 32), gyre(8, 16, 32))
    still, swung = gyre(0, 16, 32), gyre(2, 16, 32)
    assert still[1, 0, :16].max() < 0 < still[1, 0, 16:].min()
    assert swung[1, 0, 17] > 0 or swung[1, 0, 14] < 0
    assert not torch.allclose(still, swung)
    edge = max(still[0, 0].abs().max(), still[1, :, 0].abs().max())
    assert edge < 0.3 * still.abs().max()
    assert DoubleGyre(speed=2.0)(0, 64, 128).abs().max() == pytest.approx(2.0, rel=0.02)


def test_the_fastest_ring_of_a_vortex_has_its_strength() -> None:
    field = Vortices((2.0,), radius=0.2)(0, 101, 101)
    speed = field.square().sum(0).sqrt()
    assert speed.max() == pytest.approx(2.0, rel=0.01)
    assert abs(int(speed[50, 50:].argmax()) - 0.2 * 101 * 1.1209) <= 1.5
    assert field[0, 50, 80] < 0  # the right side goes up: counter-clockwise


def test_a_vortex_on_a_torus_is_the_same_near_its_core() -> None:
    free = Vortices((2.0,), radius=0.06)(0, 64, 64)
    torus = Vortices((2.0,), radius=0.06, periodic=True)(0, 64, 64)
    near = slice(27, 37)
    assert (free - torus)[:, near, near].abs().max() < 0.12


def test_the_jet_of_a_pair_goes_up() -> None:
    field = vortex_pair(2.0)(0, 40, 40)
    assert field[0, 20, 20] < -2
    assert vortex_pair(-2.0)(0, 40, 40)[0, 20, 20] > 2


def test_wrong_numbers_are_refused_in_a_sentence() -> None:
    with pytest.raises(ValueError, match="2 numbers for 1 centers"):
        Vortices((1.0, 2.0))
    with pytest.raises(ValueError, match=r"radius=-1\.0 must be above 0"):
        Vortices(radius=-1.0)
    with pytest.raises(ValueError, match=r"swing=0\.5 must lie in"):
        DoubleGyre(swing=0.5)
    with pytest.raises(ValueError, match=r"stir=-1\.0 must be at least 0"):
        StableFluid(stir=-1.0)
    with pytest.raises(ValueError, match="resolution=2 must be at least 4"):
        StableFluid(resolution=2)
    with pytest.raises(ValueError, match="frame=-1 must be at least 0"):
        StableFluid()(-1, 8, 8)


def test_examples() -> None:
    assert doctest.testmod(fluids, extraglobs={"torch": torch}).failed == 0
