"""The quadtree pyramid: lower bounds, what it finds, what it refuses."""

import pytest
import torch
from conftest import corner, noise, stripes
from torch import Tensor

from torchtex.matching import Chunked, Clustered, Exact
from torchtex.patches import ssd, ssd_search, summed_area
from torchtex.qtp import Qtp
from torchtex.quadratic import threads


def zones() -> list[Tensor]:
    return [corner(12, 3), torch.ones(9, 7, dtype=torch.bool), noise(11, 10, seed=24) > 0.6]


@pytest.mark.parametrize("mask", zones(), ids=["corner", "full", "scattered"])
def test_pyramid_finds_what_was_cut_out(mask: Tensor) -> None:
    z, (h, w) = noise(3, 40, 44, seed=25), mask.shape
    t = z[:, 13 : 13 + h, 21 : 21 + w]
    costs, positions = Qtp().fit(z, mask).search(torch.where(mask, t, float("nan"))[None], 1)
    assert positions.tolist() == [[[13, 21]]]
    assert costs.item() == pytest.approx(0, abs=1e-20)


@pytest.mark.parametrize("mask", zones(), ids=["corner", "full", "scattered"])
@pytest.mark.parametrize("axes", [None, 5])
def test_every_level_is_a_lower_bound(mask: Tensor, axes: int | None) -> None:
    z, t = noise(2, 26, 30, seed=26), noise(3, 2, *mask.shape, seed=27)
    index = Qtp(keep=(1000, 1000), axes=axes, matcher=Chunked()).fit(z, mask)
    exact = ssd_search(z)(t, mask).flatten(1)
    assert len(index.places) == exact.shape[1]
    costs, positions = index.search(t, 1000)  # nothing is left out, so the answer is exact
    assert torch.allclose(costs, exact.sort(dim=1)[0], rtol=1e-9)
    rows, cols = positions.unbind(2)
    assert torch.allclose(costs, exact.gather(1, rows * (30 - mask.shape[1] + 1) + cols), rtol=1e-9)
    for level in index.levels:
        assert int(level.cells[:, 2:].prod(1).sum()) == int(mask.sum())
    x = torch.where(mask, t - index.mean, 0)
    bounds = [
        (level.of(x, summed_area(x))[:, None] - level.at(index.places)).square().sum(2)
        for level in index.levels
    ]
    assert torch.allclose(bounds[2], exact, rtol=1e-9)
    assert all(bool((bound <= exact + 1e-9).all()) for bound in bounds[:2])
    energies = ssd(z - index.mean, torch.zeros_like(t[0]), mask).flatten()
    assert torch.allclose(index.index.keys.square().sum(1), energies, rtol=1e-9)


@pytest.mark.parametrize("matcher", [Exact(), Chunked(), Clustered(clusters=8, least=0)])
def test_pyramid_comes_near_the_least_cost(matcher: Exact | Chunked | Clustered) -> None:
    z, mask = stripes(64, 64, seed=28), corner(16, 4)
    other = stripes(64, 64, seed=29)
    t = torch.stack([other[:, i : i + 16, 2 * i : 2 * i + 16] for i in range(12)])
    costs, _ = Qtp(matcher=matcher).fit(z, mask).search(t, 3)
    exact = ssd_search(z)(t, mask).flatten(1).amin(1)
    assert bool((costs[:, 0] >= exact * (1 - 1e-9)).all())
    assert float((costs[:, 0] / exact).median()) <= 1.05
    assert bool((costs.diff(dim=1) >= 0).all())


def test_pyramid_keeps_off_unusable_pixels() -> None:
    z, mask = noise(1, 30, 30, seed=30), corner(8, 2)
    usable = torch.ones(30, 30, dtype=torch.bool)
    usable[10:14, 10:14] = False
    z[:, ~usable] = float("nan")
    index = Qtp().fit(z, mask, usable)
    assert len(index.places) == int(ssd(z, z[:, :8, :8], mask, usable=usable).isfinite().sum())
    _, positions = index.search(noise(4, 1, 8, 8, seed=31), 24)
    for r, c in positions.flatten(0, 1).tolist():
        assert bool(usable[r : r + 8, c : c + 8][mask].all())


def test_pyramid_has_the_same_bits_with_any_number_of_threads() -> None:
    z, t, mask = noise(3, 90, 90, seed=32), noise(30, 3, 16, 16, seed=33), corner(16, 4)
    found = []
    for count in (1, 2):
        with threads(count):
            found.append(Qtp().fit(z, mask).search(t, 4))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_pyramid_keeps_the_dtype() -> None:
    z = noise(3, 30, 30, seed=34, dtype=torch.float32)
    costs, positions = Qtp().fit(z, corner(8, 2)).search(z[None, :, 3:11, 4:12], 2)
    assert costs.dtype == torch.float32
    assert positions[0, 0].tolist() == [3, 4]


@pytest.mark.usefixtures("unchecked")
def test_bad_input_gets_one_clear_sentence() -> None:
    z, t = noise(3, 10, 10), noise(3, 4, 4)
    none = torch.zeros(4, 4, dtype=torch.bool)
    cases = [
        (lambda: Qtp(keep=()), "keep="),
        (lambda: Qtp(axes=0), "axes=0"),
        (lambda: Qtp().fit(t, torch.ones(5, 5, dtype=torch.bool)), "does not fit"),
        (lambda: Qtp().fit(z, none), "mask is 0 everywhere"),
        (lambda: Qtp().fit(z, ~none, torch.eye(10) > 0), "no position"),
        (lambda: Qtp().fit(z, ~none).search(t[None], 25), "k=25"),
        (lambda: Qtp().fit(z, ~none).search(z[None], 1), "the index is for"),
        (lambda: Qtp().fit(z, ~none).search(t[None] * float("nan"), 1), "template holds NaN"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()
