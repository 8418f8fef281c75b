"""Chaotic operations: the paper's numbers, reproducible sets, plans as JSON."""

import json
from itertools import islice

import pytest

from torchtex.layers.chaos import MAPS, Henon, Logistic, Tent, chaotic_map, whole_numbers
from torchtex.layers.plans import DIRECTIONS, Chaos, Operation, Plan, Ranges, Selection


def test_the_defaults_are_those_of_the_paper() -> None:
    assert chaotic_map() == Logistic(0.76234783, 2.0)
    x, found = 0.76234783, list(islice(Logistic().numbers(), 20))
    for number in found:
        assert number == abs(x)
        x = 1 - 2 * x**2


def test_the_example_of_the_paper() -> None:
    chosen = Selection(u=10, v=4, xi=0.13)
    assert chosen.kind(37) == "scale"
    assert chosen.extent(37, (0.8, 1.2)) == pytest.approx(0.91)
    assert chosen.extent(33, (0.8, 1.2)) == 0.8  # 0.39, brought into the range


@pytest.mark.parametrize("name", MAPS)
def test_numbers_are_whole_and_spread(name: str) -> None:
    for seed in range(20):
        found = list(islice(whole_numbers(chaotic_map(name, seed)), 2000))
        assert min(found) >= 0
        assert max(found) <= 255
        assert len(set(found)) > 150
        assert len(set(found[-500:])) > 100  # it does not come to rest


@pytest.mark.parametrize("name", MAPS)
def test_every_seed_has_a_plan_of_its_own(name: str) -> None:
    plans = [Chaos(name).plan(4, seed) for seed in range(50)]
    assert plans == [Chaos(name).plan(4, seed) for seed in range(50)]
    assert len(set(plans)) == 50


def test_combinations_are_of_different_kinds_and_stay_in_range() -> None:
    ranges = Ranges((0.1, 0.2), (5.0, 40.0), (0.9, 1.1))
    plan = Chaos(combined=3, iterations=2, ranges=ranges).plan(30, 3)
    for layer in plan.layers:
        assert len(layer) == 6
        for half in (layer[:3], layer[3:]):
            assert len({operation.kind for operation in half}) == 3
        for operation in layer:
            assert operation.direction in DIRECTIONS[operation.kind]
            low, high = getattr(ranges, operation.kind, (0, 0))
            assert low <= operation.amount <= high
    assert {operation.kind for layer in plan.layers for operation in layer} == set(DIRECTIONS)


def test_a_plan_survives_json_and_hands() -> None:
    plan = Chaos().plan(3, 9)
    value = json.loads(json.dumps(plan.plain()))
    assert Plan.read(value) == plan
    value[1] = [{"kind": "rotate", "direction": "clockwise", "amount": 12}]
    assert Plan.read(value).layers[1] == (Operation("rotate", "clockwise", 12.0),)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({}, "no list of lists"),
        ([[3]], "layer 0, operation 0"),
        ([[], [{"kind": "bend"}]], "layer 1, operation 0: kind='bend'"),
        ([[{"kind": "rotate", "direction": "up", "amount": 3}]], "direction='up'"),
        ([[{"kind": "scale", "amount": 30}]], "0.1..10"),
        ([[{"kind": "scale", "amount": "big"}]], "amount='big'"),
        ([[{"kind": "scale", "size": 1}]], "kind, direction and amount"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_a_bad_plan_is_refused_where_it_is_bad(value: object, words: str) -> None:
    with pytest.raises(ValueError, match=words.replace("(", r"\(")):
        Plan.read(value)


def test_bad_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match=r"x0=2"):
        Logistic(2.0)
    with pytest.raises(ValueError, match=r"slope=2"):
        Tent(0.3, 2.0)
    with pytest.raises(ValueError, match=r"a=3"):
        Henon(a=3.0)
    with pytest.raises(ValueError, match="map='cat'"):
        chaotic_map("cat")
    with pytest.raises(ValueError, match="seed=-1"):
        chaotic_map("tent", -1)
    with pytest.raises(ValueError, match="rests at"):
        list(islice(whole_numbers(Logistic(0.5)), 20))
    with pytest.raises(ValueError, match=r"scale=0.05"):
        Ranges(scale=(0.05, 1.0))
    with pytest.raises(ValueError, match="u=2"):
        Selection(u=2)
    with pytest.raises(ValueError, match="v=5"):
        Selection(v=5)
    with pytest.raises(ValueError, match="combined=5"):
        Chaos(combined=5)
    with pytest.raises(ValueError, match="iterations=0"):
        Chaos(iterations=0)
