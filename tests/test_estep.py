"""E-steps: one contract for all, and what each promises beside it."""

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex.controls import SoftConstraint
from torchtex.energy import Objective
from torchtex.estep import Auto, ClosedForm, Descend, EStep
from torchtex.features import Feature, Gradients, Pixels, Wavelets
from torchtex.model import exact_search, texture_model
from torchtex.neighborhoods import Grid

BOUNDED = [ClosedForm(), ClosedForm(tolerance=0.0, steps=1)]
ESTEPS = [
    Descend("lbfgs"),
    Descend("adam"),
    Descend("adam", rate=30.0),
    Descend("lbfgs", steps=1),
    Auto(),
    Auto(descend=Descend("adam", steps=3)),
]


def smooth(x: Tensor) -> Tensor:
    return x.diff(dim=1).square().sum()


def squares(image: Tensor) -> Tensor:
    return torch.cat([image, image.square()])


def objective(feature: Feature, r: float, *more: tuple[float, object]) -> Objective:
    model = texture_model([stripes(18, 20)], Grid(14, 15, 6, 3), feature=feature, r=r,
                          search=exact_search())  # fmt: skip
    labels = model.match(noise(3, 14, 15, seed=1))
    pull = SoftConstraint(noise(3, 14, 15, seed=2), noise(14, 15, seed=3).round())
    return Objective(((1.0, model.energy(labels)), (0.5, pull), *more))


@pytest.mark.parametrize("r", [0.5, 0.8, 1.5, 2.0])
@pytest.mark.parametrize("feature", [Pixels(), Gradients(), Wavelets("db2")], ids=repr)
@pytest.mark.parametrize("estep", [*BOUNDED, *ESTEPS], ids=repr)
def test_an_estep_never_raises_a_bounded_objective(
    estep: EStep, feature: Feature, r: float
) -> None:
    assert isinstance(estep, EStep)
    whole = objective(feature, r)
    x = noise(3, 14, 15, seed=1)
    before = x.clone()
    for _ in range(2):
        after = estep(whole, x)
        assert after.shape == x.shape
        assert not after.requires_grad
        assert whole(after) <= whole(x) * (1 + 1e-9)
        x = after
    assert torch.equal(before, noise(3, 14, 15, seed=1))
    if estep != Descend("adam", rate=30.0):
        assert whole(x) < whole(before)


@pytest.mark.parametrize("estep", ESTEPS, ids=repr)
def test_an_estep_never_raises_any_objective(estep: EStep) -> None:
    whole = objective(squares, 0.8, (2.0, smooth))
    x = noise(3, 14, 15, seed=1)
    after = estep(whole, x)
    assert whole(after) <= whole(x)


def test_the_closed_form_of_a_quadratic_is_reached_at_once() -> None:
    for feature in (Pixels(), Gradients()):
        whole = objective(feature, 2.0)
        estep = ClosedForm(tolerance=1e-9)
        first = estep(whole, noise(3, 14, 15, seed=1))
        torch.testing.assert_close(estep(whole, first), first, atol=1e-6, rtol=0)
        descended = Descend(steps=200)(whole, noise(3, 14, 15, seed=1))
        torch.testing.assert_close(descended, first, atol=1e-3, rtol=0)


def test_auto_is_the_closed_form_where_there_is_one() -> None:
    x = noise(3, 14, 15, seed=1)
    whole = objective(Gradients(), 0.8)
    assert torch.equal(Auto()(whole, x), ClosedForm()(whole, x))
    free = objective(Gradients(), 0.8, (1.0, smooth))
    assert torch.equal(Auto()(free, x), Descend()(free, x))


def test_the_closed_form_refuses_what_has_no_bound() -> None:
    with pytest.raises(ValueError, match=r"estep=ClosedForm\(\) needs a quadratic bound"):
        ClosedForm()(objective(Pixels(), 0.8, (1.0, smooth)), noise(3, 14, 15))


def test_a_descent_that_meets_nan_keeps_the_old_pixels() -> None:
    def trap(x: Tensor) -> Tensor:
        return (x - 0.999).log().sum().nan_to_num(nan=float("nan"))

    x = noise(1, 4, 4)
    assert torch.equal(Descend("adam")(Objective(((1.0, trap),)), x), x)


def test_an_estep_works_without_gradients_turned_on() -> None:
    x = noise(3, 14, 15, seed=1)
    with torch.no_grad():
        for estep in (Descend("lbfgs", steps=2), Descend("adam", steps=2), ClosedForm()):
            for feature in (Pixels(), Gradients()):
                whole = objective(feature, 0.8)
                assert whole(estep(whole, x)) < whole(x)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"optimizer": "sgd"}, 'optimizer="sgd" must be "lbfgs" or "adam"'),
        ({"steps": 0}, "steps=0 must be at least 1"),
        ({"rate": 0.0}, "rate=0.0 must be above 0"),
    ],
)
def test_wrong_settings_say_what_is_wrong(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Descend(**options)
