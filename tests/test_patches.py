"""Patch search: transforms against definitions, canvas overlaps, choices."""

import pytest
import torch
from conftest import corner, noise, stripes
from torch import Tensor

from torchtex import patches
from torchtex.patches import box_sums, ssd, ssd_canvas, ssd_exhaustive, ssd_search, summed_area
from torchtex.picks import pick, pick_soft
from torchtex.quadratic import threads


def by_windows(z: Tensor, t: Tensor, weights: Tensor) -> Tensor:
    h, w = weights.shape
    windows = z.unfold(1, h, 1).unfold(2, w, 1)
    return ((windows - t[:, None, None]).square() * weights).sum((0, 3, 4))


def test_box_sums_are_sums_of_boxes() -> None:
    x = noise(2, 9, 11, seed=1)
    expected = x.unfold(1, 3, 1).unfold(2, 4, 1).sum((3, 4))
    assert torch.allclose(box_sums(summed_area(x), 3, 4), expected, rtol=1e-12)
    assert summed_area(x.float()).dtype == torch.float64
    assert torch.allclose(box_sums(summed_area(x), 9, 11), x.sum((1, 2))[:, None, None])


@pytest.mark.parametrize("kind", ["none", "bool", "weights"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ssd_is_the_definition(kind: str, dtype: torch.dtype) -> None:
    z, t = noise(3, 31, 26, seed=2, dtype=dtype), noise(3, 9, 7, seed=3, dtype=dtype)
    mask = {"none": None, "bool": noise(9, 7, seed=4) > 0.6, "weights": noise(9, 7, seed=5)}[kind]
    if kind == "weights":
        mask = mask.to(dtype)
    weights = torch.ones(9, 7) if mask is None else mask
    expected = by_windows(z.double(), t.double(), weights.double())
    for costs in (ssd(z, t, mask), ssd_exhaustive(z, t, mask)):
        assert costs.dtype == dtype
        assert torch.allclose(
            costs.double(), expected, rtol=1e-5 if dtype == torch.float32 else 1e-11
        )


def test_large_offsets_do_not_cancel() -> None:
    z, t = 1000 + noise(1, 24, 24, seed=6), 1000 + noise(1, 8, 8, seed=7)
    assert torch.allclose(ssd(z, t), ssd_exhaustive(z, t), rtol=1e-9)


def test_perfect_matches_cost_nothing_and_tie() -> None:
    z = noise(3, 12, 12, seed=8).repeat(1, 2, 2)
    costs = ssd(z, z[:, 2:8, 3:9])
    assert costs[2, 3] == costs[14, 15] == costs[14, 3] == costs[2, 15] == 0
    assert int((costs == 0).sum()) == 4


def test_a_batch_is_its_templates_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patches, "_TRANSFORMED", 7 * 3 * 20 * 24)  # seven at a time
    z, t = noise(3, 20, 22, seed=9), noise(20, 3, 6, 5, seed=10)
    masks = noise(20, 6, 5, seed=11) > 0.5
    search = ssd_search(z)
    one = torch.stack([ssd(z, a, masks[0]) for a in t])
    many = torch.stack([ssd(z, a, m) for a, m in zip(t, masks, strict=True)])
    assert torch.allclose(search(t, masks[0]), one, rtol=1e-12)
    assert torch.allclose(search(t, masks), many, rtol=1e-12)


def test_unusable_pixels_are_never_matched() -> None:
    z = noise(1, 20, 20, seed=12)
    usable = noise(20, 20, seed=13) > 0.03
    z[:, ~usable] = float("nan")
    mask = corner(6, 2)
    t = torch.where(mask, noise(1, 6, 6, seed=14), float("nan"))  # unknown pixels may be anything
    costs = ssd(z, t, mask, usable=usable)
    touches = by_windows((~usable).double()[None], torch.zeros(1, 6, 6), mask.double()) > 0
    assert torch.equal(costs.isinf(), touches)
    expected = by_windows(z.nan_to_num(), t.nan_to_num(), mask.double())
    assert torch.allclose(costs[~touches], expected[~touches], rtol=1e-11)


def test_canvas_costs_are_those_of_each_overlap() -> None:
    x, z = noise(3, 9, 11, seed=15), noise(3, 6, 5, seed=16)
    filled, usable = noise(9, 11, seed=17) > 0.4, noise(6, 5, seed=18) > 0.2
    x[:, ~filled] = float("nan")
    for known in (None, usable):
        costs, areas = ssd_canvas(x, filled, z, usable=known)
        assert costs.shape == areas.shape == (14, 15)
        k = torch.ones(6, 5, dtype=torch.bool) if known is None else known
        for i in range(14):
            for j in range(15):
                cost, area = 0.0, 0
                for a, b in k.nonzero().tolist():
                    r, c = i - 5 + a, j - 4 + b
                    if 0 <= r < 9 and 0 <= c < 11 and filled[r, c]:
                        cost += float((x[:, r, c] - z[:, a, b]).square().sum())
                        area += 1
                assert int(areas[i, j]) == area
                assert float(costs[i, j]) == (pytest.approx(cost) if area else float("inf"))


def test_same_bits_with_any_number_of_threads() -> None:
    z, t = noise(3, 64, 60, seed=19), noise(4, 3, 16, 16, seed=20)
    filled = noise(64, 60, seed=21) > 0.5
    found = []
    for count in (1, 2):
        with threads(count):
            found.append((ssd_search(z)(t), *ssd_canvas(z, filled, t[0])))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_pick_stays_within_the_tolerance() -> None:
    costs = noise(10, 12, seed=22)
    generator = torch.Generator().manual_seed(0)
    picked = {pick(costs, 0.5, generator) for _ in range(200)}
    allowed = {tuple(p) for p in (costs <= 1.5 * costs.min()).nonzero().tolist()}
    assert picked == allowed
    again = torch.Generator().manual_seed(0)
    assert pick(costs, 3.0, torch.Generator().manual_seed(0)) == pick(costs, 3.0, again)


def test_pick_soft_follows_its_probabilities() -> None:
    costs = torch.tensor([[1.0, 2.0], [float("inf"), 1.5]])
    generator = torch.Generator().manual_seed(1)
    count = torch.zeros(2, 2)
    for _ in range(4000):
        count[pick_soft(costs, 0.5, generator)] += 1
    expected = torch.exp(-costs / 0.5)
    assert torch.allclose(count / 4000, expected / expected.sum(), atol=0.02)
    assert pick_soft(costs * 1e6, 1e-9, generator) == (0, 0)


@pytest.mark.usefixtures("unchecked")
def test_bad_input_gets_one_clear_sentence() -> None:
    z, t = noise(3, 10, 10), noise(3, 4, 4)
    none = torch.zeros(4, 4, dtype=torch.bool)
    generator = torch.Generator()
    cases = [
        (lambda: ssd(t, z), "does not fit in the exemplar of 4 x 4"),
        (lambda: ssd(z, t, none), "mask is 0 everywhere"),
        (lambda: ssd(z, t, -torch.ones(4, 4)), "negative"),
        (lambda: ssd(z, t, torch.ones(3, 4)), "mask has shape"),
        (lambda: ssd(z, t * float("nan")), "template holds NaN"),
        (lambda: ssd(z * float("inf"), t), "exemplar holds NaN"),
        (lambda: ssd(z, t[:1]), "1 channels"),
        (lambda: ssd(z, t, usable=torch.zeros(10, 10, dtype=torch.bool)), "usable is False"),
        (lambda: ssd_canvas(t, none, z), "filled is False everywhere"),
        (lambda: ssd_canvas(t[:1], ~none, z), "1 channels"),
        (lambda: ssd_canvas(t * float("nan"), ~none, z), "canvas holds NaN"),
        (lambda: pick(noise(2, 2), -1.0, generator), "tolerance=-1.0"),
        (lambda: pick(torch.full((2, 2), float("inf")), 0.1, generator), "none of 4 is finite"),
        (lambda: pick_soft(noise(2, 2), 0.0, generator), "scale=0.0"),
        (lambda: pick_soft(noise(2, 2) * float("nan"), 1.0, generator), "NaN at 4"),
        (lambda: box_sums(summed_area(noise(3, 3)), 4, 1), "height=4"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()


def test_stripes_are_found_again_after_noise() -> None:
    z = stripes(40, 40)
    t = z[:, 11:23, 7:19] + 0.02 * (noise(3, 12, 12, seed=23) - 0.5)
    costs = ssd(z, t)
    assert divmod(int(costs.argmin()), costs.shape[1]) == (11, 7)
