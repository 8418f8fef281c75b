"""Texture energy: its gradient, its quadratic bound, guides, periodic borders."""

import doctest
from dataclasses import dataclass

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex import energy
from torchtex.controls import Guide, SoftConstraint
from torchtex.energy import Bounded, Energy, Objective, TextureEnergy, Windows
from torchtex.estep import ClosedForm
from torchtex.features import Feature, Gradients, Pixels, Stack, Wavelets
from torchtex.model import exact_search, texture_model
from torchtex.neighborhoods import Grid, falloff


def squared(image: Tensor) -> Tensor:
    return torch.cat([image, image.square()])


LINEAR = [Pixels(), Gradients(), Wavelets("db2"), Wavelets(mode="window")]


def texture_energy(
    feature: Feature, *, r: float = 0.8, periodic: bool = False, guides: tuple[Guide, ...] = ()
) -> TextureEnergy:
    grid = Grid(9, 10, 4, 2, periodic)
    model = texture_model(
        [stripes(13, 12, 2)], grid, feature=feature, search=exact_search(), r=r, guides=guides
    )
    generator = torch.Generator().manual_seed(3)
    return model.energy(torch.randint(len(model.space), (len(grid),), generator=generator))


def guide() -> Guide:
    return Guide([noise(1, 13, 12, seed=8)], noise(1, 9, 10, seed=9), weight=2.5)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("feature", [*LINEAR, squared], ids=str)
def test_gradcheck(feature: Feature, periodic: bool) -> None:
    e = texture_energy(feature, periodic=periodic)
    x = noise(2, 9, 10, seed=4).requires_grad_()
    assert torch.autograd.gradcheck(e, (x,), fast_mode=True)
    assert torch.autograd.gradgradcheck(e, (x,), fast_mode=True)


def test_gradcheck_with_a_guide() -> None:
    for feature in (*LINEAR, squared):
        x = noise(2, 9, 10, seed=4).requires_grad_()
        e = texture_energy(feature, guides=(guide(),))
        assert torch.autograd.gradcheck(e, (x,), fast_mode=True)


@pytest.mark.parametrize("r", [0.3, 0.8, 1.5, 2.0])
@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("feature", LINEAR, ids=repr)
def test_the_bound_touches_at_x_and_lies_above(feature: Feature, r: float, guided: bool) -> None:
    e = texture_energy(feature, r=r, guides=(guide(),) if guided else ())
    x = noise(2, 9, 10, seed=4)
    q = e.quadratic_bound(x)
    assert q is not None
    torch.testing.assert_close(q(x), e(x), rtol=1e-10, atol=1e-10)
    for seed in range(12):
        scale = (0.01, 0.3, 3.0)[seed % 3]
        y = x + scale * (noise(2, 9, 10, seed=100 + seed) - 0.5)
        assert q(y) >= e(y) - 1e-9 * q(y).abs()
    # same slope at x
    leaf = x.clone().requires_grad_()
    slope = torch.autograd.grad(e(leaf), leaf)[0]
    torch.testing.assert_close(2 * (q.apply(x) - q.b), slope, rtol=1e-7, atol=1e-9)
    if r == 2:
        y = noise(2, 9, 10, seed=77)
        torch.testing.assert_close(q(y), e(y), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("feature", LINEAR, ids=repr)
def test_for_r_2_the_closed_form_equals_a_long_lbfgs_run(feature: Feature, periodic: bool) -> None:
    e = texture_energy(feature, r=2.0, periodic=periodic, guides=(guide(),))
    objective = Objective(((1.0, e),))
    closed = ClosedForm(tolerance=1e-10, steps=300)(objective, noise(2, 9, 10, seed=5))
    y = noise(2, 9, 10, seed=6).requires_grad_()
    optimizer = torch.optim.LBFGS(
        [y],
        max_iter=300,
        tolerance_grad=1e-10,
        tolerance_change=0,
        line_search_fn="strong_wolfe",
    )

    def closure() -> float:
        optimizer.zero_grad()
        value = e(y)
        value.backward()
        return float(value.detach())

    optimizer.step(closure)
    torch.testing.assert_close(closed, y.detach(), rtol=0, atol=1e-5)


def test_energy_by_hand() -> None:
    e = texture_energy(Pixels(), r=0.8)
    x = noise(2, 9, 10, seed=4)
    grid = e.windows.grid
    root = falloff(4).sqrt().flatten().repeat_interleave(2)
    gap = grid.gather(x) * root - e.targets(slice(0, grid.shape[0]))
    norm = gap.square().sum(1)
    torch.testing.assert_close(e.distances(x), norm)
    torch.testing.assert_close(e(x), (norm + e.eps**2).pow(0.4).sum())
    leaf = norm.clone().requires_grad_()
    slope = torch.autograd.grad(e.of_distances(leaf), leaf)[0]
    torch.testing.assert_close(e.site_weights(norm), slope)


def test_bands_do_not_change_the_energy_or_the_bound() -> None:
    image = stripes(40, 40, 1)
    for feature in (Pixels(), Gradients()):
        model = texture_model([image], Grid(40, 36, 4, 1), feature=feature, search=exact_search())
        labels = torch.arange(len(model.grid)) % len(model.space)
        whole = model.energy(labels)
        banded = TextureEnergy(
            Windows(model.grid, feature, most=1), whole.targets, whole.r, whole.eps
        )
        assert len(banded.windows.bands) > 5
        assert len(whole.windows.bands) == 1
        x, y = noise(1, 40, 36), noise(1, 40, 36, seed=1)
        torch.testing.assert_close(banded(x), whole(x))
        a, b = banded.quadratic_bound(x), whole.quadratic_bound(x)
        assert a is not None
        assert b is not None
        torch.testing.assert_close(a(y), b(y))


@pytest.mark.parametrize("feature", [*LINEAR, squared], ids=str)
def test_a_periodic_energy_does_not_know_the_border(feature: Feature) -> None:
    windows = Windows(Grid(12, 16, 4, 2, periodic=True), feature)
    x = noise(2, 12, 16)
    rolled = windows.channels(x.roll((5, 3), (1, 2)))
    torch.testing.assert_close(rolled, windows.channels(x).roll((5, 3), (1, 2)))


def test_a_guide_adds_its_squared_distance() -> None:
    plain, guided = texture_energy(Pixels()), texture_energy(Pixels(), guides=(guide(),))
    x = noise(2, 9, 10, seed=4)
    more = guided.distances(x) - plain.distances(x)
    assert more.min() > 0
    doubled = texture_energy(Pixels(), guides=(guide(), guide()))
    torch.testing.assert_close(doubled.distances(x) - plain.distances(x), 2 * more)
    grid = guided.windows.grid
    generator = torch.Generator().manual_seed(3)
    labels = torch.randint(10 * 9, (len(grid),), generator=generator)
    theirs = Grid(13, 12, 4, 1).gather(guide().exemplars[0])[labels]
    ours = grid.gather(guide().texture)
    expected = 2.5 * ((ours - theirs).square() * falloff(4).flatten()).sum(1)
    torch.testing.assert_close(more, expected)


@dataclass(frozen=True)
class Unbounded:
    """An energy that says that it has no bound here."""

    def __call__(self, x: Tensor) -> Tensor:
        return x.square().sum()

    def quadratic_bound(self, x: Tensor) -> None:
        return None


def test_an_objective_is_a_weighted_sum_and_bounded_only_if_every_term_is() -> None:
    x = noise(2, 9, 10)
    e = texture_energy(Gradients())
    pull = SoftConstraint(noise(2, 9, 10, seed=1), noise(9, 10, seed=2))
    both = Objective(((0.5, e), (3.0, pull)))
    torch.testing.assert_close(both(x), 0.5 * e(x) + 3 * pull(x))
    bound = both.quadratic_bound(x)
    assert bound is not None
    torch.testing.assert_close(bound(x), both(x))
    assert Objective(((1.0, e), (1.0, Tensor.sum))).quadratic_bound(x) is None
    assert Objective(((1.0, e), (1.0, Unbounded()))).quadratic_bound(x) is None
    assert Objective(((1.0, e), (-1.0, pull))).quadratic_bound(x) is None
    assert texture_energy(squared).quadratic_bound(x) is None
    assert isinstance(e, Energy)
    assert isinstance(e, Bounded)
    assert isinstance(Tensor.sum, Energy)


def test_stacked_features_share_one_bound() -> None:
    e = texture_energy(Stack((Pixels(), Gradients(mu=1.0)), (0.3, 2.0)))
    x, y = noise(2, 9, 10), noise(2, 9, 10, seed=1)
    q = e.quadratic_bound(x)
    assert q is not None
    torch.testing.assert_close(q(x), e(x))
    assert q(y) >= e(y)


def test_the_examples_run() -> None:
    assert doctest.testmod(energy).failed == 0
