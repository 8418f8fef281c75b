"""The loop: the energy never increases, half-step by half-step."""

from itertools import pairwise

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex.controls import Guide, SoftConstraint
from torchtex.em import HalfStep, em
from torchtex.estep import Auto, ClosedForm, Descend, EStep
from torchtex.features import Feature, Gradients, Pixels, Stack, Wavelets
from torchtex.matching import Chunked, Clustered
from torchtex.model import Search, TextureModel, exact_search, fast_search, texture_model
from torchtex.neighborhoods import Grid

SEARCHES = {
    "exact": exact_search(),
    "fast": fast_search(),
    "chunked": Search(Chunked()),
    "clustered": Search(Clustered(clusters=12, probes=1, least=0)),
    "reduced": Search(
        Clustered(clusters=12, probes=2, least=0), dimensions=6, candidates=3, coherence=True
    ),
}


def squares(image: Tensor) -> Tensor:
    return torch.cat([image, image.square()])


def model_of(
    feature: Feature, search: str, r: float, *, periodic: bool = False, guided: bool = False
) -> TextureModel:
    guides = [Guide([stripes(26, 24, 1)], stripes(24, 20, 1, seed=3))] if guided else []
    return texture_model(
        [stripes(26, 24)],
        Grid(24, 20, 8, 4, periodic),
        feature=feature,
        search=SEARCHES[search],
        r=r,
        guides=guides,
    )


def falls(energies: tuple[float, ...]) -> bool:
    return all(after <= before * (1 + 1e-9) for before, after in pairwise(energies))


@pytest.mark.parametrize("r", [0.5, 0.8, 1.5, 2.0])
@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("feature", [Pixels(), Gradients()], ids=repr)
def test_energy_never_increases_per_half_step(feature: Feature, search: str, r: float) -> None:
    fit = em(noise(3, 24, 20), [model_of(feature, search, r)], [], Auto(), steps=6)
    assert len(fit.energies) >= 4
    assert falls(fit.energies)
    assert fit.energies[-1] < fit.energies[0]


@pytest.mark.parametrize("estep", [ClosedForm(), Descend("lbfgs", 5), Descend("adam", 5)], ids=repr)
@pytest.mark.parametrize(
    "feature",
    [Pixels(), Wavelets("db2"), Wavelets(mode="window"), Stack((Pixels(), Gradients(mu=2.0)))],
    ids=repr,
)
@pytest.mark.parametrize("periodic", [False, True])
def test_nor_with_any_estep_and_feature(estep: EStep, feature: Feature, periodic: bool) -> None:
    model = model_of(feature, "fast", 0.8, periodic=periodic, guided=True)
    assert falls(em(noise(3, 24, 20), [model], [], estep, steps=4).energies)


def test_nor_with_a_feature_and_a_control_that_are_not_linear() -> None:
    def shade(x: Tensor) -> Tensor:
        return (x.mean() - 0.3).square() * x.numel()

    model = model_of(squares, "fast", 0.8)
    assert falls(em(noise(3, 24, 20), [model], [(2.0, shade)], Auto(), steps=4).energies)


@pytest.mark.parametrize("r", [0.5, 0.8, 1.5, 2.0])
@pytest.mark.parametrize("estep", [ClosedForm(), Descend("lbfgs", 5), Descend("adam", 5)], ids=repr)
def test_with_a_soft_constraint_no_estep_raises_it(estep: EStep, r: float) -> None:
    """The M-step then minimises |x - z|^2 + lambda |z - target|^2, which is not the objective."""
    pull = SoftConstraint(noise(3, 24, 20, seed=1), noise(24, 20, seed=2).round())
    model = model_of(Pixels(), "fast", r)
    energies = em(noise(3, 24, 20), [model], [(0.5, pull)], estep, steps=6).energies
    halves = list(zip(energies[::2], energies[1::2], strict=True))
    assert all(after <= before * (1 + 1e-9) for before, after in halves)


def test_a_constraint_of_no_weight_changes_nothing() -> None:
    pull = SoftConstraint(noise(3, 24, 20, seed=1), noise(24, 20, seed=2))
    with_it, without = (
        em(noise(3, 24, 20), [model_of(Pixels(), "exact", 0.8)], terms, Auto(), steps=5)
        for terms in ([(0.0, pull)], [])
    )
    assert torch.equal(with_it.labels[0], without.labels[0])
    torch.testing.assert_close(with_it.texture, without.texture)


def test_two_models_are_two_terms() -> None:
    first = model_of(Pixels(), "exact", 0.8)
    second = texture_model([stripes(20, 20, seed=5)], Grid(24, 20, 6, 3), search=exact_search())
    fit = em(noise(3, 24, 20), [first, second], [], Auto(), steps=5)
    assert [len(labels) for labels in fit.labels] == [len(first.grid), len(second.grid)]
    assert falls(fit.energies)


def test_on_step_sees_every_half_step() -> None:
    seen: list[HalfStep] = []
    fit = em(
        noise(3, 24, 20), [model_of(Pixels(), "exact", 0.8)], [], Auto(), steps=3,
        on_step=seen.append,
    )  # fmt: skip
    assert [half.half for half in seen] == ["M", "E"] * (len(seen) // 2)
    assert tuple(half.energy for half in seen) == fit.energies
    assert [half.step for half in seen[::2]] == list(range(len(seen) // 2))
    assert seen[0].changed == 1
    assert all(0 <= half.changed <= 1 for half in seen)
    assert torch.equal(seen[-1].texture, fit.texture)


def test_the_loop_stops_when_no_label_changes() -> None:
    model = model_of(Pixels(), "exact", 2.0)
    fit = em(noise(3, 24, 20), [model], [], Auto(), steps=200)
    assert len(fit.energies) < 400
    assert torch.equal(model.match(fit.texture, fit.labels[0]), fit.labels[0])


def test_labels_may_be_given() -> None:
    model = model_of(Pixels(), "exact", 0.8)
    x = noise(3, 24, 20)
    first = em(x, [model], [], Auto(), steps=2)
    second = em(first.texture, [model], [], Auto(), steps=2, labels=first.labels)
    assert falls((*first.energies, *second.energies))


def test_no_step_is_refused() -> None:
    with pytest.raises(ValueError, match="steps=0 must be at least 1"):
        em(noise(3, 24, 20), [model_of(Pixels(), "exact", 0.8)], [], Auto(), steps=0)
