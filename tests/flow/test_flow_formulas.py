"""Every kind of flow: the contract, what each does to areas, and seamless tiles."""

import doctest
import math

import pytest
import torch

from torchtex.flow import formulas
from torchtex.flow.fields import Flow, Given, Scaled, Summed, Uniform
from torchtex.flow.fluids import DoubleGyre, StableFluid
from torchtex.flow.formulas import Rotation, Saddle, Shear, Sink, Source, Wave
from torchtex.flow.strokes import Strokes
from torchtex.flow.vortices import Vortices, vortex_pair
from torchtex.flow.warps import divergence, jacobian
from torchtex.quadratic import threads

CURVE = ((0.8, 0.2), (0.3, 0.4), (0.3, 0.8))
KINDS: list[Flow] = [
    Uniform((1.0, -2.0)), Shear(angle=30.0), Rotation(3.0), Vortices(), vortex_pair(), Source(),
    Sink(), Saddle(angle=20.0), Wave(cycles=(0.5, 1.5)), DoubleGyre(), StableFluid(seed=1),
    Strokes((CURVE,)), Strokes((CURVE,), width=0.2), Scaled(Source(), 0.5),
    Summed((Sink(), Rotation())),
]  # fmt: skip
TILES: list[Flow] = [
    Uniform((1.0, -2.0)), Shear(periodic=True), Shear(angle=90.0, periodic=True),
    Vortices((3.0,), ((0.2, 0.9),), periodic=True), vortex_pair(periodic=True),
    Source(center=(0.1, 0.7), periodic=True), Sink(periodic=True),
    Saddle(center=(0.3, 0.3), periodic=True), Saddle(angle=90.0, periodic=True),
    Wave(cycles=(1.0, -2.0)), DoubleGyre(periodic=True), StableFluid(seed=2, periodic=True),
    Strokes((CURVE,), periodic=True), Strokes((CURVE,), width=0.2, periodic=True),
]  # fmt: skip
EVEN = [
    Uniform((1.0, 2.0)), Shear(), Shear(periodic=True), Rotation(5.0), Vortices((3.0,)),
    Vortices((3.0,), periodic=True), vortex_pair(periodic=True), Saddle(), Saddle(angle=40.0),
    Saddle(periodic=True), Wave(), DoubleGyre(), DoubleGyre(periodic=True),
]  # fmt: skip


@pytest.mark.parametrize("flow", KINDS + TILES, ids=repr)
def test_a_flow_gives_one_finite_field_of_any_size(flow: Flow) -> None:
    assert isinstance(flow, Flow)
    for size in ((24, 40), (33, 17)):
        field = flow(3, *size)
        assert field.shape == (2, *size)
        assert field.dtype == torch.float64
        assert field.isfinite().all()
        assert 0 < field.abs().max() < 6
        assert torch.equal(field, flow(3, *size))


@pytest.mark.parametrize("flow", KINDS + TILES, ids=repr)
def test_bits_do_not_depend_on_the_thread_count(flow: Flow) -> None:
    first = flow(1, 150, 160)
    with threads(2):
        again = StableFluid(1)(1, 150, 160) if flow == StableFluid(1) else flow(1, 150, 160)
    assert torch.equal(first, again)


@pytest.mark.parametrize("flow", TILES, ids=repr)
def test_a_periodic_field_wraps_without_a_jump(flow: Flow) -> None:
    field = flow(7, 40, 56)
    for axis in (1, 2):
        inside = field.diff(dim=axis).abs().max()
        seam = (field.select(axis, 0) - field.select(axis, -1)).abs().max()
        assert seam <= 1.3 * inside + 1e-9


@pytest.mark.parametrize("flow", EVEN, ids=repr)
def test_whirls_and_shears_change_no_area(flow: Flow) -> None:
    jac = jacobian(flow(5, 64, 64))
    area = jac[0, 0] * jac[1, 1] - jac[0, 1] * jac[1, 0]
    torch.testing.assert_close(area[2:-2, 2:-2], torch.ones(60, 60).double(), rtol=0, atol=0.01)


def test_rotation_is_rigid_and_adds_up_to_a_full_turn() -> None:
    place = torch.tensor([3.0, 11.0], dtype=torch.float64)
    for _ in range(36):
        field = Rotation(10.0)(0, 16, 16)
        row, column = place - 7.5
        turn = math.radians(10.0)
        exact = torch.stack(
            [
                row * math.cos(turn) - column * math.sin(turn),
                column * math.cos(turn) + row * math.sin(turn),
            ]
        )
        place = exact + 7.5
    torch.testing.assert_close(place, torch.tensor([3.0, 11.0], dtype=torch.float64))
    jac = jacobian(field)[:, :, 5, 5]
    torch.testing.assert_close(jac @ jac.T, torch.eye(2).double())
    up = field[:, 8, 15]
    assert up[0] < -1  # the right side goes up: counter-clockwise


def test_rotations_of_any_size_are_the_same_turn() -> None:
    small, large = Rotation(2.0)(0, 17, 17), Rotation(2.0)(0, 33, 33)
    torch.testing.assert_close(small, large[:, 8:25, 8:25])


def test_a_source_spreads_in_the_middle_and_a_sink_is_its_reverse() -> None:
    spread = divergence(Source(1.0)(0, 41, 41))
    assert spread.argmax() == 20 * 41 + 20
    assert spread.min() > 0
    assert torch.equal(Source(1.0)(0, 41, 41), -Sink(1.0)(0, 41, 41))
    assert torch.equal(Source(1.0)(0, 41, 41), Sink(-1.0)(0, 41, 41))
    speed = Source(1.0, core=0.05)(0, 41, 41).square().sum(0).sqrt()
    assert speed[20, 0] == pytest.approx(1.0, abs=0.01)


def test_a_saddle_stretches_along_its_angle() -> None:
    field = Saddle(1.0, angle=90.0)(0, 33, 33)
    assert field[0, 0, 16] < -0.9  # the top goes up
    assert field[1, 16, 0] > 0.9  # the left comes in
    assert Saddle(1.0, periodic=True)(0, 32, 32)[1, 16, 20] > 0


def test_shear_moves_along_its_angle_only() -> None:
    field = Shear(2.0, angle=30.0)(0, 20, 30)
    across = field[0] * math.cos(math.radians(30)) + field[1] * math.sin(math.radians(30))
    assert across.abs().max() < 1e-12
    assert field[1, 0, 0] > 1 > -1 > field[1, -1, -1]


def test_a_wave_travels_and_is_back_after_its_period() -> None:
    wave = Wave(1.0, (0.0, 1.0), period=8.0)
    torch.testing.assert_close(wave(0, 6, 16), wave(8, 6, 16))
    torch.testing.assert_close(wave(2, 6, 16), wave(0, 6, 16).roll(4, 2))
    assert wave(0, 6, 16)[1].abs().max() == 0  # swings across


def test_wrong_numbers_are_refused_in_a_sentence() -> None:
    with pytest.raises(ValueError, match="speed=nan must be finite"):
        Source(math.nan)
    with pytest.raises(ValueError, match=r"core=0\.0 must be above 0"):
        Sink(core=0.0)
    with pytest.raises(ValueError, match=r"angle=30\.0 must be a multiple of 90"):
        Shear(angle=30.0, periodic=True)
    with pytest.raises(ValueError, match="are no wave"):
        Wave(cycles=(0.0, 0.0))
    with pytest.raises(ValueError, match=r"center=.* must be finite"):
        Rotation(center=(math.inf, 0.5))


def test_given_flows_are_flows() -> None:
    assert isinstance(Given(torch.zeros(2, 4, 4)), Flow)


def test_examples() -> None:
    assert doctest.testmod(formulas, extraglobs={"torch": torch}).failed == 0
