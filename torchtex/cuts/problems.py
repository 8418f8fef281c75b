"""Costs of a min-cut as arrays, checked: what every back end begins with."""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class Problem(NamedTuple):
    """Costs as arrays: gain is cost 1 minus cost 0; groups of tail, head and both capacities."""

    gain: NDArray[Any]
    groups: list[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]]
    total: float
    infinite: bool


def listed_problem(unary: Tensor, edges: Tensor, capacity: Tensor) -> Problem:
    """Costs of nodes (n, 2), and of edges (e, 2) between them.

    Raises:
        ValueError: shapes that do not fit, nodes that there are none of, or costs out of range.

    Example:
        >>> listed_problem(torch.eye(2), torch.tensor([[0, 1]]), torch.ones(1, 2)).total
        4.0
    """
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


def grid_problem(unary: Tensor, right: Tensor, down: Tensor) -> Problem:
    """Costs of pixels (h, w, 2), and of edges to their right and downwards; see `cut_grid`.

    Raises:
        ValueError: as `check_grid`, or costs out of range.

    Example:
        >>> pixels = torch.zeros(2, 2, 2)
        >>> grid_problem(pixels, torch.ones(2, 1, 2), torch.ones(1, 2, 2)).total
        8.0
    """
    check_grid(unary, right, down)
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


def check_grid(unary: Tensor, right: Tensor, down: Tensor) -> None:
    """Refuses shapes that are no grid.

    Raises:
        ValueError: in one sentence, which.

    Example:
        >>> check_grid(torch.zeros(2, 3, 2), torch.zeros(2, 2, 2), torch.zeros(1, 3, 2))
    """
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


def _summed(gain: NDArray[Any], groups: list[Any]) -> Problem:
    """Adds the sum of all finite costs."""
    costs = [np.abs(gain), *(both for _, _, both in groups)]
    total = float(sum(c.sum() for c in costs))
    infinite = not np.isfinite(total)
    if infinite:
        total = float(sum(c.sum(where=np.isfinite(c)) for c in costs))
    if not total < 1e300:
        raise ValueError(f"the costs add up to {total}; divide unary and capacity by a number")
    return Problem(gain, groups, total, infinite)


def feasible(problem: Problem, labels: NDArray[np.bool_]) -> Tensor:
    """The labels as a tensor, after a look at whether they pay an infinite cost.

    Raises:
        ValueError: they do.

    Example:
        >>> costs = listed_problem(torch.eye(2), torch.tensor([[0, 1]]), torch.ones(1, 2))
        >>> feasible(costs, np.array([True, False])).tolist()
        [True, False]
    """
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
