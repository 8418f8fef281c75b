"""Min-cut: the cheapest of all binary labelings, by a back end of your choice.

    cost(labels) = sum over nodes of unary[i, labels[i]]
                 + sum over edges (s, t) of   capacity[e, 0] where labels are (0, 1)
                                              capacity[e, 1] where labels are (1, 0)

Label 0 is the source side, label 1 the sink side. Several labelings may cost the same; the one
with the fewest ones is returned, which is unique, so back ends agree but for rounding.

A back end is found by the entry-point group `torchtex.mincut`. PyMaxflow is GPL, OR-Tools is
Apache-2.0: which one to install is your choice.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchtex.cuts.problems import Problem, check_grid, feasible, grid_problem, listed_problem
from torchtex.extras import needed
from torchtex.quadratic import rowwise_sum

GROUP = "torchtex.mincut"


@runtime_checkable
class MinCut(Protocol):
    """Labeling of least cost. Costs may have any sign and be infinite; capacities are >= 0."""

    def __call__(
        self,
        unary: Float[Tensor, "n 2"],
        edges: Int[Tensor, "e 2"],
        capacity: Float[Tensor, "e 2"],
    ) -> Bool[Tensor, "n"]: ...


@runtime_checkable
class GridMinCut(Protocol):
    """Optional: the same on a 4-connected grid, without a list of edges.

    `right[i, j]` joins a pixel and its right neighbour, `down[i, j]` one and that below. One
    column less than the image has is an open grid; as many columns join the last to the first.
    """

    def grid(
        self,
        unary: Float[Tensor, "h w 2"],
        right: Float[Tensor, "h w_ 2"],
        down: Float[Tensor, "h_ w 2"],
    ) -> Bool[Tensor, "h w"]: ...


@dataclass(frozen=True)
class PyMaxflow:
    """The solver of Boykov and Kolmogorov, in float64; licence GPL.

    Raises:
        ImportError: PyMaxflow is not installed.

    Example:
        >>> unary = torch.tensor([[0.0, 9.0], [2.0, 1.0], [9.0, 0.0]])
        >>> edges = torch.tensor([[0, 1], [1, 2]])
        >>> PyMaxflow()(unary, edges, torch.tensor([[1.0, 1.0], [4.0, 4.0]])).tolist()
        [False, True, True]
    """

    def __post_init__(self) -> None:
        needed("maxflow", "solver")

    def __call__(
        self,
        unary: Float[Tensor, "n 2"],
        edges: Int[Tensor, "e 2"],
        capacity: Float[Tensor, "e 2"],
    ) -> Bool[Tensor, "n"]:
        return self._solve(listed_problem(unary, edges, capacity)).to(unary.device)

    def grid(
        self,
        unary: Float[Tensor, "h w 2"],
        right: Float[Tensor, "h w_ 2"],
        down: Float[Tensor, "h_ w 2"],
    ) -> Bool[Tensor, "h w"]:
        labels = self._solve(grid_problem(unary, right, down))
        return labels.view(unary.shape[:2]).to(unary.device)

    def _solve(self, problem: "Problem") -> Tensor:
        # an infinite cost becomes one that no saving can pay for
        gain, groups, limit = problem.gain, problem.groups, 2 * problem.total + 1
        if not gain.size:
            return torch.zeros(0, dtype=torch.bool)
        if problem.infinite:
            gain = gain.clip(-limit, limit)
            groups = [(tail, head, both.clip(None, limit)) for tail, head, both in groups]
        graph = needed("maxflow", "solver").GraphFloat(
            len(gain), sum(len(tail) for tail, _, _ in groups)
        )
        nodes = graph.add_grid_nodes(gain.shape)
        graph.add_grid_tedges(nodes, gain, np.zeros(1).repeat(len(gain)))
        for tail, head, both in groups:
            graph.add_edges(tail, head, both[:, 0], both[:, 1])
        graph.maxflow()
        return feasible(problem, graph.get_grid_segments(nodes))


@dataclass(frozen=True)
class OrTools:
    """Push-relabel of Google's OR-Tools; licence Apache-2.0.

    It counts in integers: a cost is rounded to a multiple of total (k + 1) / 2^61, where total
    is the sum of all finite costs and k the number of infinite edges.

    Raises:
        ImportError: OR-Tools is not installed.

    Example:
        >>> unary = torch.tensor([[0.0, 9.0], [2.0, 1.0], [9.0, 0.0]])
        >>> edges = torch.tensor([[0, 1], [1, 2]])
        >>> OrTools()(unary, edges, torch.tensor([[1.0, 1.0], [4.0, 4.0]])).tolist()
        [False, True, True]
    """

    def __post_init__(self) -> None:
        needed("ortools.graph.python.max_flow", "solver")

    def __call__(
        self,
        unary: Float[Tensor, "n 2"],
        edges: Int[Tensor, "e 2"],
        capacity: Float[Tensor, "e 2"],
    ) -> Bool[Tensor, "n"]:
        problem = listed_problem(unary, edges, capacity)
        (tail, head, both) = problem.groups[0]
        # node 0 is the source and 1 the sink; a node that may have one label only joins it
        ids = np.arange(2, len(problem.gain) + 2)
        ids[problem.gain == np.inf] = 0
        ids[problem.gain == -np.inf] = 1
        gain = np.where(np.isfinite(problem.gain), problem.gain, 0)
        none = np.zeros_like(ids)
        tails = np.concatenate([ids[tail], ids[head], none, ids, [0]])
        heads = np.concatenate([ids[head], ids[tail], ids, none + 1, [1]])
        costs = np.concatenate([both[:, 0], both[:, 1], gain.clip(0), (-gain).clip(0), [0]])
        used = (tails != heads) & ((costs > 0) | (heads == 1))
        flow = needed("ortools.graph.python.max_flow", "solver").SimpleMaxFlow()
        flow.add_arcs_with_capacity(
            tails[used].astype(np.int32),
            heads[used].astype(np.int32),
            _integers(costs[used], problem.total),
        )
        status = flow.solve(0, 1)
        assert status == flow.OPTIMAL, status
        side = np.zeros(len(ids) + 2, dtype=bool)
        side[flow.get_sink_side_min_cut()] = True
        return feasible(problem, side[ids]).to(unary.device)


def cut_grid(
    unary: Float[Tensor, "h w 2"],
    right: Float[Tensor, "h w_ 2"],
    down: Float[Tensor, "h_ w 2"],
    solver: MinCut | None = None,
) -> Bool[Tensor, "h w"]:
    """Labeling of least cost on a 4-connected grid, without edges where the solver can.

    Args:
        unary: cost of label 0 and 1 at each pixel.
        right, down: costs of the labels (0, 1) and (1, 0) at a pixel and its neighbour; w - 1
            columns (h - 1 rows), or as many as the image has to join the last to the first.

    Raises:
        ValueError: a cost or shape that makes no sense.

    Example:
        >>> unary = torch.tensor([[[0.0, 9.0], [1.0, 1.0], [9.0, 0.0]]])
        >>> right = torch.tensor([[[3.0, 3.0], [1.0, 1.0]]])
        >>> cut_grid(unary, right, torch.zeros(0, 3, 2)).tolist()
        [[False, False, True]]
    """
    solver = default_solver() if solver is None else solver
    if isinstance(solver, GridMinCut):
        return solver.grid(unary, right, down)
    check_grid(unary, right, down)
    edges = grid_edges(unary.shape[0], unary.shape[1], right.shape[1], down.shape[0])
    capacity = torch.cat([right.flatten(0, 1), down.flatten(0, 1)])
    labels = solver(unary.flatten(0, 1), edges.to(unary.device), capacity)
    return labels.view(unary.shape[:2])


def grid_edges(h: int, w: int, columns: int, rows: int) -> Int[Tensor, "e 2"]:
    """Edges of an h x w grid of row-major nodes: those to the right, then those down.

    Args:
        columns, rows: w - 1 and h - 1, or w and h to join the last to the first.

    Example:
        >>> grid_edges(1, 3, 2, 0).tolist()
        [[0, 1], [1, 2]]
    """
    node = torch.arange(h * w).view(h, w)
    right = torch.stack([node[:, :columns], node.roll(-1, 1)[:, :columns]], -1)
    down = torch.stack([node[:rows], node.roll(-1, 0)[:rows]], -1)
    return torch.cat([right.flatten(0, 1), down.flatten(0, 1)])


def cut_energy(
    labels: Bool[Tensor, "n"],
    unary: Float[Tensor, "n 2"],
    edges: Int[Tensor, "e 2"],
    capacity: Float[Tensor, "e 2"],
) -> Float[Tensor, ""]:
    """The cost that a min-cut minimises.

    Example:
        >>> edges, capacity = torch.tensor([[0, 1]]), torch.tensor([[5.0, 7.0]])
        >>> cut_energy(torch.tensor([True, False]), torch.zeros(2, 2), edges, capacity).item()
        7.0
    """
    first, second = labels[edges[:, 0]], labels[edges[:, 1]]
    zero = capacity.new_zeros(())
    pair = torch.where(~first & second, capacity[:, 0], zero)
    pair = torch.where(first & ~second, capacity[:, 1], pair)
    return rowwise_sum(torch.where(labels, unary[:, 1], unary[:, 0])) + rowwise_sum(pair)


def solvers() -> dict[str, bool]:
    """Names of the known back ends, and whether each can be used here.

    Example:
        >>> sorted(solvers())[:2]
        ['ortools', 'pymaxflow']
    """
    return {entry.name: _made(entry) is not None for entry in _entries()}


def default_solver() -> MinCut:
    """The first back end that can be used: PyMaxflow, OR-Tools, then those of third parties.

    Raises:
        ImportError: there is none.

    Example:
        >>> isinstance(default_solver(), MinCut)
        True
    """
    for entry in _entries():
        solver = _made(entry)
        if solver is not None:
            return solver
    raise ImportError(
        "no min-cut back end is installed; pip install 'torchtex[graphcut]' brings two, or choose "
        "by licence: PyMaxflow is GPL, ortools is Apache-2.0"
    )


def _integers(costs: NDArray[np.float64], total: float) -> NDArray[np.int64]:
    """Costs as integers whose sum is below 2^62; infinite ones exceed the sum of the others."""
    infinite = ~np.isfinite(costs)
    share = np.where(infinite, 0, costs) / (total if total > 0 else 1)
    whole = np.rint(share * (2.0**61 / (infinite.sum() + 1))).astype(np.int64)
    whole[infinite] = whole.sum() + 1
    return whole


def _entries() -> Iterator[EntryPoint]:
    """The two built-in back ends, known even where the package is not installed, then others."""
    ours = {"pymaxflow": "PyMaxflow", "ortools": "OrTools"}
    for name, kind in ours.items():
        yield EntryPoint(name, f"{__name__}:{kind}", GROUP)
    others = {entry.name: entry for entry in entry_points(group=GROUP)}
    yield from (others[name] for name in sorted(others) if name not in ours)


def _made(entry: EntryPoint) -> MinCut | None:
    try:
        solver: MinCut = entry.load()()
    except (ImportError, AttributeError):
        return None
    return solver
