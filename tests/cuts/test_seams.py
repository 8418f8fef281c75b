"""Seams: against formulas pixel by pixel, against brute force, and against each other."""

import itertools

import pytest
import torch
from conftest import noise, stripes
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchtex.cuts.mincut import MinCut, cut_energy, grid_edges
from torchtex.cuts.seams import (
    FLOOR,
    cut_patch,
    cut_seam,
    patch_views,
    present_seams,
    seam_costs,
    seam_energy,
)


def labelings(h: int, w: int) -> Tensor:
    return torch.tensor(list(itertools.product([False, True], repeat=h * w))).view(-1, h, w)


def least(energies: list[Tensor]) -> float:
    return min(float(e) for e in energies)


def masks(h: int, w: int) -> tuple[Tensor, Tensor]:
    """The first column forced to the first picture, the last one to the second."""
    first = torch.zeros(h, w, dtype=torch.bool)
    first[:, 0] = True
    return first, first.flip(1)


def patchwork(h: int, w: int, seed: int, patches: int = 3) -> Tensor:
    """Views of a canvas whose pixels come from several pictures, as if pasted one by one."""
    generator = torch.Generator().manual_seed(seed)
    owner = torch.randint(patches, (h, w), generator=generator)
    views = patch_views(noise(3, h + 2, w + 2, seed=seed))[..., 1:-1, 1:-1]
    for k in range(1, patches):
        other = patch_views(noise(3, h + 2, w + 2, seed=100 * k + seed))[..., 1:-1, 1:-1]
        views = torch.where(owner == k, other, views)
    return views


def total(views: Tensor, gradient: bool = False) -> Tensor:
    return torch.stack([cost.sum() for cost in present_seams(views, gradient=gradient)]).sum()


@pytest.mark.parametrize("gradient", [False, True])
def test_seam_costs_are_the_formula_at_every_pair(gradient: bool) -> None:
    a, b = noise(3, 4, 5), noise(3, 4, 5, seed=1)
    right, down = seam_costs(a, b, gradient=gradient, wrap=(True, True))
    for i, j in itertools.product(range(4), range(5)):
        for cost, s, t in ((right, (i, j), (i, (j + 1) % 5)), (down, (i, j), ((i + 1) % 4, j))):
            (p, q), (u, v) = s, t
            expected = (a[:, p, q] - b[:, p, q]).norm() + (a[:, u, v] - b[:, u, v]).norm()
            if gradient:
                slopes = [(x[:, u, v] - x[:, p, q]).norm() for x in (a, b)]
                expected = expected / (2 * slopes[0] + 2 * slopes[1] + FLOOR)
            torch.testing.assert_close(cost[i, j], expected)
    open_right, open_down = seam_costs(a, b, gradient=gradient)
    assert torch.equal(open_right, right[:, :-1])
    assert torch.equal(open_down, down[:-1])


@pytest.mark.parametrize("directed", [False, True])
@pytest.mark.parametrize("wrap", [False, True])
def test_cut_seam_equals_brute_force(solver: MinCut, directed: bool, wrap: bool) -> None:
    h, w, rows = 3, 3, 3 if wrap else 2
    right, down = noise(h, w - 1, 2, seed=1), noise(rows, w, 2, seed=2)
    if not directed:
        right[..., 1], down[..., 1] = right[..., 0], down[..., 0]
    unary, (first, second) = noise(h, w, 2, seed=3), masks(h, w)
    costs = (right, down) if directed else (right[..., 0], down[..., 0])
    found = cut_seam(*costs, first, second, unary=unary, solver=solver)
    edges = grid_edges(h, w, w - 1, rows)
    capacity = torch.cat([right.flatten(0, 1), down.flatten(0, 1)])

    def energy(labels: Tensor) -> Tensor:
        return cut_energy(labels.flatten(), unary.flatten(0, 1), edges, capacity)

    allowed = [x for x in labelings(h, w) if x[second].all() and not x[first].any()]
    assert float(energy(found)) == pytest.approx(least([energy(x) for x in allowed]))
    assert found[second].all()
    assert not found[first].any()


def test_cut_seam_follows_a_valley_and_closes_around_a_tube(solver: MinCut) -> None:
    right, down = torch.full((6, 7), 2.0), torch.full((5, 8), 0.1)
    path = torch.tensor([1, 2, 3, 4, 5, 6])
    right[torch.arange(6), path] = 0.5
    labels = cut_seam(right, down, *masks(6, 8), solver=solver)
    assert torch.equal(labels, torch.arange(8) > path[:, None])
    tube = torch.cat([down, torch.full((1, 8), 5.0)])  # dear to jump between last row and first
    closed = cut_seam(right, tube, *masks(6, 8), solver=solver)
    assert torch.equal(closed[0], closed[5])
    assert seam_energy(closed, right, tube) < seam_energy(labels, right, tube)


def test_no_seam_where_pictures_agree() -> None:
    picture = stripes(9, 11)
    right, down = seam_costs(picture, picture)
    labels = cut_seam(right, down, *masks(9, 11))
    assert seam_energy(labels, right, down) == 0
    views = patch_views(picture)
    assert total(torch.where(cut_patch(views, views, *masks(9, 11)), views, views)) == 0


def pairs(old: Tensor, new: Tensor, gradient: bool) -> list[tuple[tuple[int, ...], Tensor]]:
    """Pixels s and t of every pair, and the costs of old beside old, old, new, and new, old."""
    h, w = old.shape[2:]
    found = []
    for i, j, axis in itertools.product(range(h), range(w), (0, 1)):
        u, v = (i + 1, j) if axis == 0 else (i, j + 1)
        if u < h and v < w:
            a_s = old[[0, 1 + axis], :, i, j]  # what the patch of s shows at s and at t
            a_t = old[[3 + axis, 0], :, u, v]
            b = torch.stack([new[0, :, i, j], new[0, :, u, v]])
            costs = []
            for p, q in ((a_s, a_t), (a_s, b), (b, a_t)):
                slope = 2 * (p[1] - p[0]).norm() + 2 * (q[1] - q[0]).norm() + FLOOR
                costs.append((p - q).norm(dim=1).sum() / (slope if gradient else 1))
            found.append(((i, j, u, v), torch.stack(costs)))
    return found


def with_seam_nodes(labels: Tensor, old: Tensor, new: Tensor) -> float:
    """Cost of a labeling in the graph of the paper, its seam nodes at their best side."""
    cost = 0.0
    for (i, j, u, v), (present, leave, enter) in pairs(old, new, False):
        s, t = labels[i, j], labels[u, v]
        sides = [present * (not n) + leave * (s != n) + enter * (t != n) for n in (False, True)]
        cost += least(sides)
    return cost


def truncated(labels: Tensor, old: Tensor, new: Tensor) -> float:
    """Cost of a labeling, old seams weighed by gradients and cut down to submodular."""
    cost = 0.0
    for (i, j, u, v), (present, leave, enter) in pairs(old, new, True):
        s, t = bool(labels[i, j]), bool(labels[u, v])
        stay = torch.minimum(present, leave + enter)
        cost += float(
            {(False, False): stay, (False, True): leave, (True, False): enter}.get((s, t), 0)
        )
    return cost


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.sampled_from([(2, 3), (3, 3), (1, 5), (4, 2)]), st.booleans())
def test_cut_patch_leaves_the_least_seams_of_all_labelings(
    seed: int, shape: tuple[int, int], forced: bool
) -> None:
    h, w = shape
    old = patchwork(h, w, seed)
    new = patch_views(noise(3, h + 2, w + 2, seed=seed + 1))[..., 1:-1, 1:-1]
    first, second = masks(h, w)
    first[0, 0] = True
    if not forced:
        second = torch.zeros_like(second)
    found = cut_patch(old, new, first, second)
    allowed = [x for x in labelings(h, w) if x[second].all() and not x[first].any()]
    energies = [total(torch.where(x, new, old)) for x in allowed]
    assert float(total(torch.where(found, new, old))) == pytest.approx(least(energies))
    # and that is the minimum of the graph with one node for each old seam
    graph = min(with_seam_nodes(x, old, new) for x in allowed)
    assert float(total(torch.where(found, new, old))) == pytest.approx(graph)


def test_cut_patch_with_gradients_equals_brute_force(solver: MinCut) -> None:
    bent = 0
    for seed in range(4):
        old, new = patchwork(2, 4, seed), patch_views(noise(3, 2, 4, seed=seed + 9))
        first, second = masks(2, 4)
        found = cut_patch(old, new, first, second, gradient=True, solver=solver)
        allowed = [x for x in labelings(2, 4) if x[second].all() and not x[first].any()]
        expected = min(truncated(x, old, new) for x in allowed)
        assert truncated(found, old, new) == pytest.approx(expected)
        bent += sum(bool(c[0] > c[1] + c[2]) for _, c in pairs(old, new, True))
    assert bent > 0  # some seams do break the triangle inequality


def test_cut_patch_never_leaves_more_than_keeping_the_canvas(solver: MinCut) -> None:
    for seed in range(4):
        old, new = patchwork(12, 14, seed), patch_views(noise(3, 12, 14, seed=50 + seed))
        first = torch.ones(12, 14, dtype=torch.bool)
        first[1:-1, 1:-1] = False
        nothing = torch.zeros_like(first)
        labels = cut_patch(old, new, first, nothing, solver=solver)
        assert total(torch.where(labels, new, old)) <= total(old)
        bowed = cut_patch(old, new, first, nothing, gradient=True, solver=solver)
        assert not bowed[first].any()


def test_a_new_canvas_takes_the_first_patch_whole_and_pays_nothing() -> None:
    old, new = torch.zeros(5, 3, 6, 7, dtype=torch.float64), patch_views(stripes(6, 7))
    nothing = torch.zeros(6, 7, dtype=torch.bool)
    labels = cut_patch(old, new, nothing, ~nothing)
    assert labels.all()
    assert total(torch.where(labels, new, old)) == 0


def test_views_show_the_neighbours() -> None:
    picture = noise(2, 4, 5)
    views = patch_views(picture)
    assert torch.equal(views[0], picture)
    assert torch.equal(views[1, :, :-1], picture[:, 1:])
    assert torch.equal(views[2, :, :, :-1], picture[:, :, 1:])
    assert torch.equal(views[3, :, 1:], picture[:, :-1])
    assert torch.equal(views[4, :, :, 1:], picture[:, :, :-1])


def test_dtype_and_repetition() -> None:
    old, new = patchwork(9, 9, 0).float(), patch_views(noise(3, 9, 9, dtype=torch.float32))
    labels = cut_patch(old, new, *masks(9, 9))
    assert torch.equal(labels, cut_patch(old, new, *masks(9, 9)))
    assert total(torch.where(labels, new, old)).dtype == torch.float32
    assert seam_costs(old[0], new[0])[0].dtype == torch.float32


def test_refuses(unchecked: None) -> None:
    first, second = masks(3, 1)
    with pytest.raises(ValueError, match="first and second share 3 pixels"):
        cut_seam(torch.zeros(3, 0), torch.zeros(2, 1), first, second)
