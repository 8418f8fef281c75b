"""Expansion moves: exact for two labels, best of all single moves, and never upwards."""

import itertools

import pytest
import torch
from conftest import noise
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchtex.cuts.expansion import (
    Move,
    PairCost,
    Potts,
    Table,
    UnaryCost,
    every_label,
    expand,
    label_energy,
)
from torchtex.cuts.mincut import MinCut, grid_edges


class Anything:
    """Pair costs without any structure: a number for each edge and pair of labels."""

    def __init__(self, costs: Tensor) -> None:
        self.costs = costs  # e, k, k

    def __call__(self, first: Tensor, second: Tensor) -> Tensor:
        return self.costs[torch.arange(len(self.costs)), first, second]


def all_labelings(n: int, k: int) -> Tensor:
    return torch.tensor(list(itertools.product(range(k), repeat=n)))


def minimum(candidates: Tensor, unary: UnaryCost, edges: Tensor, pairwise: PairCost) -> float:
    return min(float(label_energy(x, unary, edges, pairwise)) for x in candidates)


def drawn(seed: int, n: int, k: int) -> tuple[Tensor, Table, Tensor]:
    """Labels to begin with, unary costs and edges of a random graph."""
    generator = torch.Generator().manual_seed(seed)
    labels = torch.randint(k, (n,), generator=generator)
    edges = torch.randint(n, (2 * n, 2), generator=generator)
    return labels, Table(4 * noise(n, k, seed=seed) - 2), edges


def metric(seed: int, e: int, k: int) -> Anything:
    """Shortest paths between labels, other ones at each edge."""
    costs = noise(e, k, k, seed=seed + 1) + 0.1
    costs = (costs + costs.mT) * (1 - torch.eye(k))
    for middle in range(k):
        costs = torch.minimum(costs, costs[:, :, middle, None] + costs[:, None, middle])
    return Anything(costs)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.integers(1, 8))
def test_two_labels_with_submodular_costs_are_exact(seed: int, n: int) -> None:
    labels, unary, edges = drawn(seed, n, 2)
    costs = 3 * noise(len(edges), 2, 2, seed=seed + 1) - 1
    costs[:, 0, 1] += (costs[:, 0, 0] + costs[:, 1, 1] - costs[:, 0, 1] - costs[:, 1, 0]).clamp(0)
    pairwise = Anything(costs)
    found, energies = expand(labels, every_label(2, n), unary, edges, pairwise)
    best = minimum(all_labelings(n, 2), unary, edges, pairwise)
    assert energies[-1] == pytest.approx(best, abs=1e-12)
    assert float(label_energy(found, unary, edges, pairwise)) == pytest.approx(energies[-1])


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.integers(2, 6))
def test_no_single_move_is_better_for_metric_costs(seed: int, n: int) -> None:
    labels, unary, edges = drawn(seed, n, 3)
    pairwise = metric(seed, len(edges), 3)
    found, energies = expand(labels, every_label(3, n), unary, edges, pairwise)
    switches = all_labelings(n, 2).bool()
    for alpha in range(3):
        moves = torch.where(switches, alpha, found)
        assert energies[-1] <= minimum(moves, unary, edges, pairwise) + 1e-12


@pytest.mark.parametrize("shuffled", [False, True])
def test_energy_never_rises_for_costs_without_structure(solver: MinCut, shuffled: bool) -> None:
    for seed in range(6):
        labels, unary, edges = drawn(seed, 30, 5)
        pairwise = Anything(4 * noise(len(edges), 5, 5, seed=seed) - 2)
        generator = torch.Generator().manual_seed(seed) if shuffled else None
        seen: list[Move] = []
        found, energies = expand(
            labels,
            every_label(5, 30),
            unary,
            edges,
            pairwise,
            solver=solver,
            on_step=seen.append,
            generator=generator,
        )
        assert energies[0] == float(label_energy(labels, unary, edges, pairwise))
        assert all(after <= before for before, after in itertools.pairwise(energies))
        assert energies[-1] < energies[0]
        assert energies[-1] == float(label_energy(found, unary, edges, pairwise))
        assert [move.energy for move in seen] == energies[1:]
        assert all(
            (move.changed > 0) == (after < before)
            for move, (before, after) in zip(seen, itertools.pairwise(energies), strict=True)
        )


def test_a_truncated_move_is_never_feigned(solver: MinCut) -> None:
    """What the min-cut proposes falls in the true energy too, so no move is turned down."""
    proposed: list[bool] = []

    def watched(unary: Tensor, edges: Tensor, capacity: Tensor) -> Tensor:
        moves = solver(unary, edges, capacity)
        proposed.append(bool(moves.any()))
        return moves

    moves: list[Move] = []
    for seed in range(4):
        labels, unary, edges = drawn(seed, 20, 4)
        pairwise = Anything(4 * noise(len(edges), 4, 4, seed=seed) - 2)
        expand(
            labels,
            every_label(4, 20),
            unary,
            edges,
            pairwise,
            solver=watched,
            on_step=moves.append,
        )
    assert [move.changed > 0 for move in moves] == proposed
    assert any(proposed)


def test_proposals_may_differ_from_node_to_node(solver: MinCut) -> None:
    """Candidates of each node, as from a search: the result is made of them or of the start."""
    n, edges = 12, grid_edges(3, 4, 3, 2)
    generator = torch.Generator().manual_seed(3)
    candidates = torch.randint(1000, (4, n), generator=generator)
    wanted = candidates[2]

    def unary(labels: Tensor) -> Tensor:
        return (labels - wanted).abs().double()

    def pairwise(first: Tensor, second: Tensor) -> Tensor:
        return 1e-3 * (first - second).abs().double()

    found, energies = expand(candidates[0], candidates, unary, edges, pairwise, solver=solver)
    assert (found == candidates).any(0).all()
    assert torch.equal(found, wanted)
    assert energies[-1] < energies[0]


def test_forbidden_labels_stay_away(solver: MinCut) -> None:
    costs = noise(20, 3, seed=1)
    costs[::2, 1] = torch.inf
    costs[1::3, 2] = torch.inf
    start, edges = torch.zeros(20, dtype=torch.long), grid_edges(4, 5, 4, 3)
    unary, weight = Table(costs), torch.full((len(edges),), 0.1, dtype=torch.float64)
    found, energies = expand(start, every_label(3, 20), unary, edges, Potts(weight), solver=solver)
    assert energies[-1] < energies[0]
    assert unary(found).isfinite().all()


def test_ends_when_nothing_helps_and_repeats_itself() -> None:
    labels, unary, edges = drawn(2, 25, 4)
    pairwise = Potts(torch.full((len(edges),), 0.4, dtype=torch.float64))
    found, energies = expand(labels, every_label(4, 25), unary, edges, pairwise, sweeps=50)
    again, same = expand(labels, every_label(4, 25), unary, edges, pairwise, sweeps=50)
    assert torch.equal(found, again)
    assert energies == same
    assert len(energies) < 1 + 4 * 50
    rest, after = expand(found, every_label(4, 25), unary, edges, pairwise)
    assert torch.equal(found, rest)
    assert len(after) == 1 + 4
    still, alone = expand(labels, every_label(4, 25), unary, edges, pairwise, sweeps=0)
    assert torch.equal(still, labels)
    assert alone == energies[:1]


def test_refuses(unchecked: None) -> None:
    labels, unary, edges = drawn(0, 5, 3)
    pairwise = Potts(torch.ones(len(edges), dtype=torch.float64))
    every = every_label(3, 5)
    with pytest.raises(ValueError, match="proposals has shape"):
        expand(labels, every_label(3, 4), unary, edges, pairwise)
    with pytest.raises(ValueError, match="sweeps=-1"):
        expand(labels, every, unary, edges, pairwise, sweeps=-1)
    with pytest.raises(ValueError, match=r"edges name the nodes .* 0\.\.4"):
        expand(labels, every, unary, edges + 5, pairwise)
    with pytest.raises(ValueError, match="pairwise has a cost that is NaN or infinite"):
        expand(labels, every, unary, edges, Potts(torch.full((len(edges),), torch.inf)))
    with pytest.raises(ValueError, match="begin with labels of finite cost"):
        expand(labels, every, Table(torch.full((5, 3), torch.inf)), edges, pairwise)
