"""Rivals of constrained synthesis: the same problem, comparable labelings, limits that hold."""

from typing import Any

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex.recipes.analogy import Analogy
from torchtex.recipes.analogy_costs import energy
from torchtex.recipes.montage import Stage
from torchtex.recipes.rivals import (
    constrained_quilting,
    guided,
    labeling_of,
    random_placement,
)


def halves(h: int, w: int) -> Tensor:
    return (torch.arange(w) >= w // 2).double().expand(1, h, w)


def problem(h: int = 24, w: int = 32) -> Analogy:
    """Stripes where the map is 0 and noise where it is 1; the constraint has them exchanged."""
    maps = halves(36, 40)
    source = torch.where(maps > 0, noise(3, 36, 40), stripes(36, 40) * 0.5)
    return Analogy.of(source, maps, halves(h, w).flip(2))


def wrong(whole: Analogy, shown: Tensor) -> float:
    return float((shown - whole.constraints[0]).abs().mean())


def test_quilting_follows_the_constraint_with_blocks_down_to_the_last() -> None:
    whole = problem()
    result = constrained_quilting(whole, block=12, final=5, seed=1)
    assert torch.equal(result.apply(whole.sources[0]), result.texture)
    assert wrong(whole, result.apply(whole.mapped[0][0])) < 0.15
    assert result.settings["iterations"] == 4
    again = constrained_quilting(whole, block=12, final=5, seed=1)
    assert torch.equal(again.texture, result.texture)


def test_quilting_stacks_constraints_by_their_weights() -> None:
    source, maps = noise(3, 30, 30), (noise(1, 30, 30, seed=1), noise(2, 30, 30, seed=2))
    wanted = noise(1, 20, 20, seed=3), maps[1][:, 4:24, 6:26]
    heavy = constrained_quilting(Analogy((source,), (maps,), wanted, (1e-6, 1.0)), final=5)
    light = constrained_quilting(Analogy((source,), (maps,), wanted, (1.0, 1e-6)), final=5)
    for result, better in ((heavy, 1), (light, 0)):
        errors = [
            float((result.apply(m) - c).square().mean()) for m, c in zip(maps, wanted, strict=True)
        ]
        assert errors[better] < errors[1 - better]


def test_random_placement_lowers_the_energy_and_covers_all() -> None:
    whole = problem()
    result = random_placement(whole, K=2.0, N=2, moves=60, turns=True, mirrors=True, seed=2)
    assert torch.equal(result.montage.apply(whole.sources[0]), result.texture)
    energies = [move.energy for move in result.moves]
    assert energies == sorted(energies, reverse=True)
    assert energies[-1] == pytest.approx(result.energies.minimised, rel=1e-9)
    more = random_placement(whole, K=2.0, N=2, moves=300, turns=True, mirrors=True, seed=2)
    assert more.energies.minimised < result.energies.minimised
    assert more.tried == result.tried + 240


def test_random_placement_ends_by_its_limits() -> None:
    whole = problem()
    first = random_placement(whole, N=2, moves=10, turns=False, seed=3)
    assert torch.equal(first.texture, random_placement(whole, N=2, moves=10, turns=False,
                                                       seed=3).texture)  # fmt: skip
    assert random_placement(whole, N=2, moves=0).montage.patches.shape == (24, 32)
    told: list[Stage] = []
    timed = random_placement(whole, N=2, seconds=0.3, on_step=told.append)
    assert 0.3 <= timed.montage.seconds < 20
    assert {stage.note for stage in told} == {"filling", "improving"}


def test_guided_synthesis_follows_the_constraint() -> None:
    whole = problem(32, 40)
    result = guided(whole, seed=1)
    assert result.texture.shape == (3, 32, 40)
    assert wrong(whole, result.apply(whole.mapped[0][0])) < 0.2
    assert torch.equal(result.texture, result.apply(whole.sources[0]).clamp(0, 1))


def test_labelings_of_all_are_comparable() -> None:
    whole = problem(32, 40)
    found = {}
    for name, result in (
        ("quilt", constrained_quilting(whole, block=12, final=5)),
        ("em", guided(whole)),
    ):
        labeling = labeling_of(whole, result.source_map)
        found[name] = energy(whole, labeling, K=2.0, N=2)
        shown = result.field.source_map()
        assert torch.equal(labeling.places(), shown[..., 1:])
    flat = labeling_of(whole, torch.zeros(32, 40, 3, dtype=torch.long))
    worst = energy(whole, flat, K=2.0, N=2).agreement
    assert all(value.agreement < 0.7 * worst for value in found.values()), (found, worst)
    assert all(value.minimised > value.boundary > 0 for value in found.values())


@pytest.mark.parametrize(
    ("words", "call", "options"),
    [
        ("final=2 must lie in 3..36", constrained_quilting, {"final": 2}),
        ("final=40 must lie in 3..36", constrained_quilting, {"final": 40}),
        ("block=5 must lie in final=7..36", constrained_quilting, {"block": 5}),
        ("block=99", constrained_quilting, {"block": 99}),
        ("tolerance=-1", constrained_quilting, {"tolerance": -1.0}),
        ("seed=-1", constrained_quilting, {"seed": -1}),
        ("moves or seconds: none given", random_placement, {}),
        ("moves=-1", random_placement, {"moves": -1}),
        ("seconds=0", random_placement, {"seconds": 0.0}),
        ("K=-1", random_placement, {"K": -1.0, "moves": 1}),
        ("N=0", random_placement, {"N": 0, "moves": 1}),
        ("seed=-1", random_placement, {"moves": 1, "seed": -1}),
        ("weight=-1", guided, {"weight": -1.0}),
    ],
)
def test_options_that_make_no_sense(words: str, call: Any, options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=words):
        call(problem(), **options)
