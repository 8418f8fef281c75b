"""Quadratics: minima equal a dense solve, conjugate gradients restore low frequencies."""

import doctest
from itertools import pairwise

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex import quadratic
from torchtex.controls import SoftConstraint
from torchtex.energy import Objective, TextureEnergy
from torchtex.features import Feature, Gradients, Pixels, Stack, Wavelets
from torchtex.model import exact_search, texture_model
from torchtex.neighborhoods import Grid
from torchtex.quadratic import Quadratic, diagonal, minimise, rowwise_sum, total

FEATURES = [
    Pixels(),
    Gradients(),
    Wavelets("db2"),
    Wavelets(mode="window"),
    Stack((Pixels(), Gradients(mu=1.0)), (0.2, 1.0)),
]


def dense(q: Quadratic, x: Tensor) -> tuple[Tensor, Tensor]:
    basis = torch.eye(x.numel(), dtype=x.dtype).view(-1, *x.shape)
    return torch.stack([q.apply(e).flatten() for e in basis], 1), q.b.flatten()


def energy_of(feature: Feature, *, periodic: bool = False, r: float = 0.8) -> TextureEnergy:
    grid = Grid(10, 11, 4, 2, periodic)
    model = texture_model([stripes(14, 13, 2)], grid, feature=feature, search=exact_search(), r=r)
    pick = torch.randint(len(model.space), (len(grid),), generator=torch.Generator().manual_seed(3))
    return model.energy(pick)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("feature", FEATURES, ids=repr)
def test_minimum_equals_a_dense_solve(feature: Feature, periodic: bool) -> None:
    x = noise(2, 10, 11, seed=5)
    q = energy_of(feature, periodic=periodic).quadratic_bound(x)
    assert q is not None
    a, b = dense(q, x)
    torch.testing.assert_close(a, a.T)
    assert torch.linalg.eigvalsh(a).min() > 0
    solved = torch.linalg.solve(a, b).view(x.shape)
    torch.testing.assert_close(minimise(q, x, tolerance=1e-12), solved, rtol=1e-7, atol=1e-8)


def test_minimum_of_a_sum_equals_a_dense_solve() -> None:
    x = noise(2, 10, 11, seed=5)
    pull = SoftConstraint(noise(2, 10, 11, seed=6), noise(10, 11, seed=7).round())
    q = Objective(((0.7, energy_of(Gradients())), (2.0, pull))).quadratic_bound(x)
    assert q is not None
    a, b = dense(q, x)
    solved = torch.linalg.solve(a, b).view(x.shape)
    torch.testing.assert_close(minimise(q, x, tolerance=1e-12), solved, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize(
    "feature", [Gradients(), Wavelets("db2"), Wavelets(mode="window")], ids=repr
)
def test_a_heavy_control_does_not_stop_the_search_beside_it(feature: Feature) -> None:
    x = noise(2, 10, 11, seed=5)
    held = torch.zeros(10, 11, dtype=torch.float64)
    held[:, :5] = 1e5
    pull = SoftConstraint(noise(2, 10, 11, seed=6), held)
    q = Objective(((1.0, energy_of(feature)), (1.0, pull))).quadratic_bound(x)
    assert q is not None
    a, b = dense(q, x)
    solved = torch.linalg.solve(a, b).view(x.shape)
    assert (minimise(q, x, tolerance=1e-4, steps=100) - solved).abs().max() < 0.01


def test_a_pixel_that_nothing_holds_keeps_its_colour() -> None:
    x = noise(1, 4, 4)
    weight = torch.ones(1, 4, 4, dtype=torch.float64)
    weight[0, 1, 2] = 0
    lowest = minimise(diagonal(weight, torch.zeros_like(x)), x)
    assert lowest[0, 1, 2] == x[0, 1, 2]
    assert lowest.count_nonzero() == 1


def test_value_of_a_diagonal_and_of_a_sum() -> None:
    weight, target, x = noise(1, 3, 4), noise(2, 3, 4, seed=1), noise(2, 3, 4, seed=2)
    q = diagonal(weight, target)
    expected = (weight * (x - target).square()).sum()
    torch.testing.assert_close(q(x), expected)
    torch.testing.assert_close(total([(2.0, q), (0.5, q)])(x), 2.5 * expected)


@pytest.mark.parametrize("mu", [1.0, 10.0, 100.0])
def test_gradients_from_a_cold_start_restore_the_low_frequencies(mu: float) -> None:
    wanted = stripes(48, 40) * 0.4
    wanted[:, :, 20:] += 0.5
    grid = Grid(48, 40, 8, 2)
    model = texture_model([wanted], grid, feature=Gradients(mu=mu), search=exact_search())
    labels = model.space.at(torch.cat([torch.zeros(len(grid), 1).long(), grid.sites], 1))
    calls = 0
    q = model.energy(labels).quadratic_bound(torch.zeros_like(wanted))
    assert q is not None

    def counted(x: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        return q.apply(x)

    watched = Quadratic(counted, q.b, q.constant, q.weight, q.response)
    found = minimise(watched, torch.zeros_like(wanted), tolerance=1e-4, steps=60)
    assert calls < 50
    torch.testing.assert_close(found.mean((1, 2)), wanted.mean((1, 2)), atol=2e-3, rtol=0)
    assert (found - wanted).abs().max() < 0.03


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("steps", [5, 200])
def test_a_black_target_gives_black_and_no_nan(dtype: torch.dtype, steps: int) -> None:
    grid = Grid(12, 12, 4, 2)
    black = torch.zeros(1, 12, 12, dtype=dtype)
    model = texture_model([black], grid, feature=Gradients(), search=exact_search())
    q = model.energy(torch.zeros(len(grid)).long()).quadratic_bound(noise(1, 12, 12, dtype=dtype))
    assert q is not None
    found = minimise(q, noise(1, 12, 12, dtype=dtype), steps=steps)
    assert found.isfinite().all()
    assert found.abs().max() < (0.2 if steps == 5 else 1e-3)
    assert minimise(q, black, steps=steps).abs().max() == 0


def test_more_steps_never_raise_the_quadratic() -> None:
    x = noise(2, 10, 11, seed=5)
    q = energy_of(Gradients()).quadratic_bound(x)
    assert q is not None
    values = [float(q(minimise(q, x, steps=steps, tolerance=0.0))) for steps in range(0, 30, 3)]
    assert all(b <= a * (1 + 1e-12) + 1e-12 for a, b in pairwise(values))


def test_the_examples_run() -> None:
    assert doctest.testmod(quadratic).failed == 0


def test_blockwise_sum() -> None:
    for n in (0, 1, 1023, 1024, 5000):
        torch.testing.assert_close(rowwise_sum(noise(n)), noise(n).sum())
