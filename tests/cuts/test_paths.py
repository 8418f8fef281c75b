"""Paths: equal to brute force, along both axes, closed; a min-cut of a quilt is never dearer."""

import itertools

import pytest
import torch
from conftest import noise, stripes

from torchtex.cuts.mincut import MinCut
from torchtex.cuts.paths import dp_mask, dp_seam, quilt_cut, quilt_mask
from torchtex.cuts.seams import patch_views, present_seams


def paths(h: int, w: int, closed: bool) -> list[list[int]]:
    every = itertools.product(range(w), repeat=h)
    return [
        list(p)
        for p in every
        if all(abs(a - b) <= 1 for a, b in itertools.pairwise(p))
        and (not closed or abs(p[0] - p[-1]) <= 1)
    ]


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize(("h", "w"), [(1, 1), (1, 4), (5, 1), (5, 4), (6, 3), (4, 5)])
def test_dp_seam_is_the_cheapest_path(closed: bool, h: int, w: int) -> None:
    for seed in range(5):
        error = noise(h, w, seed=seed)
        seam = dp_seam(error, closed=closed).tolist()
        rows = torch.arange(h)
        expected = min(float(error[rows, p].sum()) for p in paths(h, w, closed))
        assert seam in paths(h, w, closed)
        assert float(error[rows, seam].sum()) == pytest.approx(expected)


def test_dp_mask_runs_along_either_axis() -> None:
    error = noise(7, 5)
    mask = dp_mask(error, 0)
    assert torch.equal(mask, torch.arange(5) > dp_seam(error)[:, None])
    assert torch.equal(dp_mask(error.T, 1), mask.T)
    closed = dp_seam(error, closed=True)
    assert torch.equal(dp_mask(error, 0, closed=True).long().sum(1), 4 - closed)
    assert dp_seam(torch.ones(4, 3)).tolist() == [0, 0, 0, 0]  # straight on


@pytest.mark.parametrize(("left", "top"), [(6, 0), (0, 6), (6, 5), (0, 0), (1, 1)])
@pytest.mark.parametrize("gradient", [False, True])
def test_the_min_cut_of_a_quilt_costs_no_more_than_its_paths(
    solver: MinCut, left: int, top: int, gradient: bool
) -> None:
    for seed in range(3):
        old = patch_views(noise(3, 20, 22, seed=seed))[..., 1:-1, 1:-1]
        new = patch_views(stripes(20, 22, seed=seed))[..., 1:-1, 1:-1]
        overlap = torch.zeros(18, 20, dtype=torch.bool)
        overlap[:, :left] = True
        overlap[:top] = True
        by_path = quilt_mask(old[0], new[0], left, top)
        by_cut = quilt_cut(old, new, left, top, gradient=gradient, solver=solver)
        costs = []
        for mask in (by_path, by_cut):
            assert mask[~overlap].all()
            assert not mask[:, : min(left, 1)].any()
            assert not mask[: min(top, 1)].any()
            seams = present_seams(torch.where(mask, new, old), gradient=gradient)
            costs.append(float(seams[0].sum() + seams[1].sum()))
        assert costs[1] <= costs[0] * (1 + 1e-12)


def test_the_cut_of_a_quilt_runs_where_the_pictures_agree_best() -> None:
    block = torch.ones(1, 12, 12, dtype=torch.float64)
    block[..., 2:4] = 0.2
    old, new = patch_views(torch.zeros_like(block)), patch_views(block)
    assert quilt_cut(old, new, 6, 0).sum(1).tolist() == [9] * 12


def test_refuses(unchecked: None) -> None:
    with pytest.raises(ValueError, match="axis=2"):
        dp_mask(torch.zeros(3, 3), 2)
    with pytest.raises(ValueError, match="NaN or infinite"):
        dp_seam(torch.full((3, 3), torch.nan))
    with pytest.raises(ValueError, match="at least one pixel"):
        dp_seam(torch.zeros(3, 0))
    block = torch.zeros(3, 8, 8)
    with pytest.raises(ValueError, match=r"left=9 must lie in 0\.\.8"):
        quilt_mask(block, block, 9, 0)
    with pytest.raises(ValueError, match=r"top=9 must lie in 0\.\.8"):
        quilt_cut(patch_views(block), patch_views(block), 0, 9)
