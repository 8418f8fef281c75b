"""Expansion moves: label energies lowered by one min-cut after another.

    energy(labels) = sum over nodes of unary(labels)[i]
                   + sum over edges (s, t) of pairwise(labels[s], labels[t])[e]

A move offers every node a second label; the min-cut decides for all of them at once who takes
it. Alpha-expansion offers the same label to all. Costs may differ from place to place and need
not be a metric: where a move is not submodular its graph overstates the cost of labels unlike,
so a move may be missed but none that is made costs more than it says.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.quadratic import rowwise_sum


@runtime_checkable
class UnaryCost(Protocol):
    """Cost of a label at each node; +inf forbids it."""

    def __call__(self, labels: Int[Tensor, "n"]) -> Float[Tensor, "n"]: ...


@runtime_checkable
class PairCost(Protocol):
    """Cost of a pair of labels at each edge, in the order of the edges; finite, of any sign."""

    def __call__(self, first: Int[Tensor, "e"], second: Int[Tensor, "e"]) -> Float[Tensor, "e"]: ...


@dataclass(frozen=True)
class Table:
    """The `UnaryCost` of a table with one column for each label.

    Example:
        >>> Table(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))(torch.tensor([1, 0])).tolist()
        [2.0, 3.0]
    """

    costs: Float[Tensor, "n k"]

    def __call__(self, labels: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        return self.costs.gather(1, labels[:, None])[:, 0]


@dataclass(frozen=True)
class Potts:
    """The `PairCost` that counts unlike labels: weight[e] where they differ, else 0.

    Example:
        >>> Potts(torch.tensor([5.0, 7.0]))(torch.tensor([1, 2]), torch.tensor([1, 3])).tolist()
        [0.0, 7.0]
    """

    weight: Float[Tensor, "e"]

    def __call__(self, first: Int[Tensor, "e"], second: Int[Tensor, "e"]) -> Float[Tensor, "e"]:
        return torch.where(first == second, torch.zeros_like(self.weight), self.weight)


@dataclass(frozen=True)
class Move:
    """What `on_step` is given after each move.

    Args:
        sweep, proposal: both from 0.
        changed: nodes whose label changed; 0 where the move did not help.
        energy: after it.
    """

    sweep: int
    proposal: int
    changed: int
    energy: float


def label_energy(
    labels: Int[Tensor, "n"], unary: UnaryCost, edges: Int[Tensor, "e 2"], pairwise: PairCost
) -> Float[Tensor, ""]:
    """The energy that `expand` lowers.

    Example:
        >>> unary, edges = Table(torch.zeros(2, 3)), torch.tensor([[0, 1]])
        >>> label_energy(torch.tensor([0, 2]), unary, edges, Potts(torch.ones(1))).item()
        1.0
    """
    pairs = pairwise(labels[edges[:, 0]], labels[edges[:, 1]])
    return rowwise_sum(unary(labels)) + rowwise_sum(pairs)


def every_label(count: int, nodes: int) -> Int[Tensor, "{count} {nodes}"]:
    """The proposals of alpha-expansion: each of the labels 0..count-1, at all nodes.

    Example:
        >>> every_label(2, 3).tolist()
        [[0, 0, 0], [1, 1, 1]]
    """
    return torch.arange(count)[:, None].expand(count, nodes)


def expand(
    labels: Int[Tensor, "n"],
    proposals: Int[Tensor, "k n"],
    unary: UnaryCost,
    edges: Int[Tensor, "e 2"],
    pairwise: PairCost,
    *,
    solver: MinCut | None = None,
    sweeps: int = 10,
    on_step: Callable[[Move], None] | None = None,
    generator: torch.Generator | None = None,
) -> tuple[Int[Tensor, "n"], list[float]]:
    """Lowers a label energy by moves until none of the proposals helps any more.

    The energy never rises, whatever the costs: a move is made only if the true energy falls.
    With two labels and submodular costs the result is the minimum. With more labels, costs that
    are a metric and at least 0, it is at most 2 r times that, where r is the largest cost of
    unlike labels over the smallest.

    Args:
        labels: where to begin; their cost must be finite.
        proposals: one labeling for each move; `every_label(count, n)` for alpha-expansion, or
            one candidate of each node in each row.
        sweeps: times that all proposals are tried at most; it ends once none of them helps.
        on_step: called after each move that was tried.
        generator: for a random order of the proposals; None keeps their order.
        solver: None for the first one that is installed.

    Returns:
        The labels, and the energies at the start and after each move that was tried.

    Raises:
        ValueError: costs that make no sense, or sizes that do not fit.

    Source: Boykov, Veksler and Zabih 2001; the decomposition of pair costs is that of
    Kolmogorov and Zabih 2004; truncation after Rother et al. 2005.

    Example:
        >>> unary = Table(torch.tensor([[0.0, 3.0, 9.0], [1.0, 0.9, 9.0], [0.0, 9.0, 9.0]]))
        >>> edges = torch.tensor([[0, 1], [1, 2]])
        >>> start = torch.tensor([0, 1, 0])
        >>> labels, energies = expand(start, every_label(3, 3), unary, edges, Potts(torch.ones(2)))
        >>> labels.tolist(), energies[0] > energies[-1]
        ([0, 0, 0], True)
    """
    _check(labels, proposals, edges, sweeps)
    solver = default_solver() if solver is None else solver
    problem = _Costs(unary, edges, pairwise, edges.cpu())
    now = problem.of(labels)
    if not now.nodes.isfinite().all():
        node = int((~now.nodes.isfinite()).nonzero()[0])
        raise ValueError(
            f"labels: label {int(labels[node])} costs {float(now.nodes[node])} at node {node}; "
            "begin with labels of finite cost"
        )
    order = torch.arange(len(proposals))
    if generator is not None:
        order = torch.randperm(len(proposals), generator=generator)
    energies, useless = [now.energy], 0
    for sweep, index in product(range(sweeps), order.tolist()):
        if useless == len(proposals):
            break
        proposal = proposals[index].to(labels)
        moves = problem.best_move(now, labels, proposal, solver).to(labels.device)
        moved = torch.where(moves, proposal, labels)
        after = problem.of(moved)
        useless += 1
        changed = 0
        if after.energy < now.energy:
            changed = int((moved != labels).sum())
            labels, now, useless = moved, after, 0
        energies.append(now.energy)
        if on_step is not None:
            on_step(Move(sweep, index, changed, now.energy))
    return labels, energies


class _Paid(NamedTuple):
    """What a labeling costs at each node and edge, in float64 on the CPU."""

    nodes: Tensor
    pairs: Tensor

    @property
    def energy(self) -> float:
        return float(rowwise_sum(self.nodes) + rowwise_sum(self.pairs))


class _Costs(NamedTuple):
    unary: UnaryCost
    edges: Tensor
    pairwise: PairCost
    at: Tensor  # the edges on the CPU, where the min-cut is solved

    def of(self, labels: Tensor) -> _Paid:
        return _Paid(_cpu(self.unary(labels)), self.between(labels, labels))

    def between(self, first: Tensor, second: Tensor) -> Tensor:
        pairs = _cpu(self.pairwise(first[self.edges[:, 0]], second[self.edges[:, 1]]))
        if not bool(pairs.isfinite().all()):
            raise ValueError(
                "pairwise has a cost that is NaN or infinite; give finite numbers, and forbid a "
                "label by an infinite cost in unary"
            )
        return pairs

    def best_move(self, now: _Paid, old: Tensor, new: Tensor, solver: MinCut) -> Tensor:
        """Which nodes take the new label: the minimum, if the move is submodular."""
        stay, enter, leave, go = (
            now.pairs,
            self.between(old, new),
            self.between(new, old),
            self.between(new, new),
        )
        # raising the cost of unlike labels can hide a good move but not feign one
        missing = (stay + go - enter - leave).clamp_min(0) / 2
        enter, leave = enter + missing, leave + missing
        nodes = torch.stack([now.nodes, _cpu(self.unary(new))], 1)
        nodes[:, 1].index_add_(0, self.at[:, 0], leave - stay)
        nodes[:, 1].index_add_(0, self.at[:, 1], go - leave)
        unlike = (enter + leave - stay - go).clamp_min(0)
        return solver(nodes, self.at, torch.stack([unlike, torch.zeros_like(unlike)], 1))


def _cpu(costs: Tensor) -> Tensor:
    return costs.detach().to("cpu", torch.float64)


def _check(labels: Tensor, proposals: Tensor, edges: Tensor, sweeps: int) -> None:
    if proposals.ndim != 2 or proposals.shape[1:] != labels.shape:
        raise ValueError(
            f"proposals has shape {tuple(proposals.shape)}; give k x {len(labels)}, a label for "
            "each node in each row"
        )
    if sweeps < 0:
        raise ValueError(f"sweeps={sweeps} must be at least 0")
    if edges.numel() and not 0 <= int(edges.min()) <= int(edges.max()) < len(labels):
        raise ValueError(
            f"edges name the nodes {int(edges.min())}..{int(edges.max())}; they must lie in "
            f"0..{len(labels) - 1}"
        )
