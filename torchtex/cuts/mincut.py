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
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

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
        return self._solve(_problem(unary, edges, capacity)).to(unary.device)

    def grid(
        self,
        unary: Float[Tensor, "h w 2"],
        right: Float[Tensor, "h w_ 2"],
        down: Float[Tensor, "h_ w 2"],
    ) -> Bool[Tensor, "h w"]:
        labels = self._solve(_grid_problem(unary, right, down))
        return labels.view(unary.shape[:2]).to(unary.device)

    def _solve(self, problem: "_Problem") -> Tensor:
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
        return _feasible(problem, graph.get_grid_segments(nodes))


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
        problem = _problem(unary, edges, capacity)
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
        return _feasible(problem, side[ids]).to(unary.device)


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
    _check_grid(unary, right, down)
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


class _Problem(NamedTuple):
    """Costs as arrays: gain is cost 1 minus cost 0; groups of tail, head and both capacities."""

    gain: NDArray[Any]
    groups: list[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]]
    total: float
    infinite: bool


def _problem(unary: Tensor, edges: Tensor, capacity: Tensor) -> _Problem:
    for name, value, rule in (
        ("unary", unary, "n x 2"),
        ("edges", edges, "e x 2"),
        ("capacity", capacity, "e x 2"),
    ):
        if value.ndim != 2 or value.shape[1] != 2:
            raise ValueError(f"{name} has shape {tuple(value.shape)}; it must be {rule}")
    if len(edges) != len(capacity):
        raise ValueError(f"edges: {len(edges)} given with {len(capacity)} capacities; give as many")
    pairs = edges.detach().cpu().numpy().astype(np.int64, copy=False)
    if pairs.size and not 0 <= pairs.min() <= pairs.max() < len(unary):
        raise ValueError(
            f"edges name the nodes {pairs.min()}..{pairs.max()}; they must lie in "
            f"0..{len(unary) - 1}"
        )
    both = _capacities(capacity, "capacity")
    other = pairs[:, 0] != pairs[:, 1]
    if not other.all():  # an edge from a node to itself is never cut
        pairs, both = pairs[other], both[other]
    return _summed(_gain(unary), [(pairs[:, 0], pairs[:, 1], both)])


def _grid_problem(unary: Tensor, right: Tensor, down: Tensor) -> _Problem:
    _check_grid(unary, right, down)
    h, w = unary.shape[:2]
    groups = []
    for axis, name, costs in ((1, "right", right), (0, "down", down)):
        both = _capacities(costs, name)
        if unary.shape[axis] > 1:  # else an edge from a pixel to itself, which is never cut
            groups.append((*_neighbours(h, w, axis, costs.shape[axis]), both))
    return _summed(_gain(unary), groups)


@lru_cache(maxsize=8)
def _neighbours(h: int, w: int, axis: int, count: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Nodes of the pairs along an axis; kept, since a recipe cuts many grids of one size."""
    node = np.arange(h * w).reshape(h, w)
    both = node, np.roll(node, -1, axis)
    tail, head = (x[:, :count].ravel() if axis else x[:count].ravel() for x in both)
    tail.flags.writeable = head.flags.writeable = False
    return tail, head


def _check_grid(unary: Tensor, right: Tensor, down: Tensor) -> None:
    """Refuses shapes that are no grid."""
    for name, value in (("unary", unary), ("right", right), ("down", down)):
        if value.ndim != 3 or value.shape[2] != 2:
            raise ValueError(f"{name} has shape {tuple(value.shape)}; it must be h x w x 2")
    h, w = unary.shape[:2]
    for name, value, shapes in (
        ("right", right, ((h, max(w - 1, 0)), (h, w))),
        ("down", down, ((max(h - 1, 0), w), (h, w))),
    ):
        if tuple(value.shape[:2]) not in shapes:
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}; for an image of {h}x{w} pixels it must "
                f"be {shapes[0][0]}x{shapes[0][1]}x2, or {h}x{w}x2 to join its ends"
            )


def _array(value: Tensor) -> NDArray[np.float64]:
    return value.detach().to("cpu", torch.float64).contiguous().numpy().reshape(-1, 2)


def _gain(unary: Tensor) -> NDArray[np.float64]:
    costs = _array(unary)
    # NaN and -inf come through a minimum, and +inf if both labels are forbidden
    low = np.minimum(costs[:, 0], costs[:, 1])
    if not np.isfinite(low).all():
        node = int(np.flatnonzero(~np.isfinite(low))[0])
        raise ValueError(
            f"unary is {costs[node].tolist()} at node {node}; a cost must be a number or +inf, "
            "and one label must be allowed"
        )
    return costs[:, 1] - costs[:, 0]


def _capacities(capacity: Tensor, name: str) -> NDArray[np.float64]:
    both = _array(capacity)
    least = both.min(initial=0)  # NaN if there is one
    if not least >= 0:
        raise ValueError(f"{name} has the value {least}; capacities must be at least 0")
    return both


def _summed(gain: NDArray[Any], groups: list[Any]) -> _Problem:
    """Adds the sum of all finite costs."""
    costs = [np.abs(gain), *(both for _, _, both in groups)]
    total = float(sum(c.sum() for c in costs))
    infinite = not np.isfinite(total)
    if infinite:
        total = float(sum(c.sum(where=np.isfinite(c)) for c in costs))
    if not total < 1e300:
        raise ValueError(f"the costs add up to {total}; divide unary and capacity by a number")
    return _Problem(gain, groups, total, infinite)


def _feasible(problem: _Problem, labels: NDArray[np.bool_]) -> Tensor:
    """The labels as a tensor, after a look at whether they pay an infinite cost."""
    if problem.infinite:
        broken = bool((np.where(labels, problem.gain, -problem.gain) == np.inf).any())
        for tail, head, both in problem.groups:
            cut = np.where(labels[tail], both[:, 1], both[:, 0])[labels[tail] != labels[head]]
            broken = broken or bool((cut == np.inf).any())
        if broken:
            raise ValueError(
                "unary and capacity are infinite such that every labeling costs inf; "
                "lift one of the constraints"
            )
    return torch.from_numpy(labels)


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
