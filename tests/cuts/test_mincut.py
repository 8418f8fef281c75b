"""Min-cut: every back end equals brute force over all labelings, and refuses the same input."""

import itertools
from pathlib import Path

import pytest
import torch
from conftest import named_solver, noise
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchtex import extras
from torchtex.cuts.mincut import (
    GridMinCut,
    MinCut,
    OrTools,
    PyMaxflow,
    cut_energy,
    cut_grid,
    default_solver,
    grid_edges,
    solvers,
)

inf = float("inf")
QUARTERS = st.integers(-12, 12).map(lambda n: n / 4)  # sums of these are exact
CAPACITIES = st.one_of(st.just(0.0), st.integers(0, 12).map(lambda n: n / 4))


def labelings(n: int) -> Tensor:
    return torch.tensor(list(itertools.product([False, True], repeat=n))).view(-1, n)


def brute_force(unary: Tensor, edges: Tensor, capacity: Tensor) -> Tensor:
    """Of the cheapest labelings, the one with the fewest ones: their intersection."""
    every = labelings(len(unary))
    costs = torch.stack([cut_energy(labels, unary, edges, capacity) for labels in every])
    return every[costs == costs.min()].all(0)


@st.composite
def problems(draw: st.DrawFn) -> tuple[Tensor, Tensor, Tensor]:
    """Up to 9 nodes, mostly not connected; directed and zero capacities, forbidden labels."""
    n = draw(st.integers(1, 9))
    node = st.integers(0, n - 1)
    edges = draw(st.lists(st.tuples(node, node), max_size=14))
    unary = [[draw(QUARTERS), draw(QUARTERS)] for _ in range(n)]
    for costs in unary:
        forbidden = draw(st.sampled_from([None, None, None, 0, 1]))
        if forbidden is not None:
            costs[forbidden] = inf
    capacity = [[draw(CAPACITIES), draw(CAPACITIES)] for _ in edges]
    as_float = {"dtype": torch.float64}
    return (
        torch.tensor(unary, **as_float),
        torch.tensor(edges, dtype=torch.long).view(-1, 2),
        torch.tensor(capacity, **as_float).view(-1, 2),
    )


@pytest.mark.parametrize("name", ["pymaxflow", "ortools"])
def test_equals_brute_force_over_all_labelings(name: str) -> None:
    solver = named_solver(name)

    @settings(max_examples=120, deadline=None, derandomize=True)
    @given(problems())
    def check(problem: tuple[Tensor, Tensor, Tensor]) -> None:
        labels = solver(*problem)
        assert torch.equal(labels, brute_force(*problem))
        assert torch.equal(labels, solver(*problem))

    check()


def test_grid_equals_the_list_of_edges(solver: MinCut) -> None:
    for h, w, columns, rows in [
        (5, 7, 6, 4),
        (5, 7, 7, 4),
        (4, 3, 2, 4),
        (2, 2, 2, 2),
        (1, 6, 6, 0),
    ]:
        unary = noise(h, w, 2, seed=h) - 0.5
        right, down = noise(h, columns, 2, seed=1) / 3, noise(rows, w, 2, seed=2) / 3
        edges = grid_edges(h, w, columns, rows)
        flat = torch.cat([right.flatten(0, 1), down.flatten(0, 1)])
        expected = solver(unary.flatten(0, 1), edges, flat)
        assert torch.equal(cut_grid(unary, right, down, solver), expected.view(h, w))


def test_back_ends_agree_on_a_larger_grid() -> None:
    unary = torch.zeros(24, 31, 2, dtype=torch.float64)
    unary[:, 0, 1], unary[:, -1, 0] = inf, inf
    right, down = noise(24, 30, 2, seed=3), noise(23, 31, 2, seed=4)
    first = cut_grid(unary, right, down, named_solver("pymaxflow"))
    assert torch.equal(first, cut_grid(unary, right, down, named_solver("ortools")))
    assert 0 < first.double().mean() < 1


def test_infinite_capacities_bind_and_parts_may_be_apart(solver: MinCut) -> None:
    unary = torch.tensor([[0.0, 5.0], [3.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    edges = torch.tensor([[0, 1]])
    labels = solver(unary, edges, torch.tensor([[inf, 0.0]]))
    assert labels.tolist() == [False, False, True, False]
    labels = solver(unary, edges, torch.tensor([[0.0, inf]]))
    assert labels.tolist() == [False, True, True, False]
    none = torch.zeros(0, 2, dtype=torch.long)
    assert solver(unary, none, torch.zeros(0, 2)).tolist() == [False, True, True, False]
    assert solver(torch.zeros(0, 2), none, torch.zeros(0, 2)).tolist() == []


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_scale_of_the_costs_does_not_matter(solver: MinCut, scale: float) -> None:
    unary, edges, capacity = noise(9, 2), grid_edges(3, 3, 2, 2), noise(12, 2, seed=1)
    expected = brute_force(unary, edges, capacity)
    assert torch.equal(solver(unary * scale, edges, capacity * scale), expected)
    unary = torch.where(torch.tensor([[True, False]] * 4 + [[False, True]] * 5), inf, unary)
    expected = brute_force(unary, edges, capacity)
    assert torch.equal(solver(unary * scale, edges, capacity * scale), expected)


UNARY = torch.zeros(3, 2)
EDGES = torch.tensor([[0, 1], [1, 2]])
CAPACITY = torch.ones(2, 2)
nan = float("nan")


@pytest.mark.parametrize(
    ("unary", "edges", "capacity", "message"),
    [
        (UNARY, EDGES, CAPACITY - 2, "capacity has the value -1"),
        (UNARY, EDGES, CAPACITY * nan, "capacity has the value nan"),
        (UNARY, EDGES + 1, CAPACITY, "edges name the nodes 1..3"),
        (UNARY, EDGES - 1, CAPACITY, "edges name the nodes -1..1"),
        (UNARY * nan, EDGES, CAPACITY, "unary is .*nan.* at node 0"),
        (UNARY + inf, EDGES, CAPACITY, "one label must be allowed"),
        (UNARY - inf, EDGES, CAPACITY, "unary is .*-inf"),
        (UNARY[:, :1], EDGES, CAPACITY, "unary has shape"),
        (UNARY, EDGES[0], CAPACITY, "edges has shape"),
        (UNARY, EDGES, CAPACITY[:, 0], "capacity has shape"),
        (UNARY, EDGES, CAPACITY[:1], "edges: 2 given with 1"),
        (torch.tensor([[0, inf], [0, 0], [inf, 0]]), EDGES, CAPACITY * inf, "every labeling"),
    ],
)
def test_refuses(
    solver: MinCut, unchecked: None, unary: Tensor, edges: Tensor, capacity: Tensor, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        solver(unary, edges, capacity)


def test_grid_refuses_shapes_that_are_no_grid(solver: MinCut, unchecked: None) -> None:
    unary, right, down = torch.zeros(3, 4, 2), torch.zeros(3, 3, 2), torch.zeros(2, 4, 2)
    with pytest.raises(ValueError, match="right has shape"):
        cut_grid(unary, right[:, :2], down, solver)
    with pytest.raises(ValueError, match="down has shape"):
        cut_grid(unary, right, down[..., 0], solver)
    with pytest.raises(ValueError, match="-1"):
        cut_grid(unary, right - 1, down, solver)


def test_keeps_to_the_protocols(solver: MinCut) -> None:
    assert isinstance(solver, MinCut)
    assert isinstance(solver, GridMinCut) == isinstance(solver, PyMaxflow)
    assert isinstance(default_solver(), MinCut)


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(module: str) -> None:
        raise ImportError(module)

    monkeypatch.setattr(extras, "import_module", missing)
    for kind in (PyMaxflow, OrTools):
        with pytest.raises(ImportError, match=r"torchtex\[graphcut\]"):
            kind()
    assert not any(solvers().values())
    with pytest.raises(ImportError, match="GPL"):
        default_solver()


def test_back_ends_of_third_parties_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "strange_cuts-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: strange-cuts\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[torchtex.mincut]\nstrange = strange_cuts:Strange\nbroken = strange_cuts:Nothing\n"
    )
    (tmp_path / "strange_cuts.py").write_text(
        "class Strange:\n    def __call__(self, unary, edges, capacity):\n"
        "        return unary[:, 1] < unary[:, 0]\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    found = solvers()
    assert found["strange"]
    assert not found["broken"]
    assert list(found)[:2] == ["pymaxflow", "ortools"]
