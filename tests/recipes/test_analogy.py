"""Analogies: what a problem may be, labelings, and energies against their definitions."""

from itertools import product

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex.image import luminance
from torchtex.recipes import analogy_costs, detail, labelings, region_maps, transfers
from torchtex.recipes.analogy import Analogy
from torchtex.recipes.labelings import Labeling, variants


def problem(channels: int = 3, size: tuple[int, int] = (9, 11)) -> Analogy:
    """Two sources of different size, and two constraints of unlike weight."""
    sources = noise(channels, 13, 17, seed=1), noise(channels, 12, 10, seed=2)
    mapped = tuple(
        (noise(1, *s.shape[1:], seed=3 + j), noise(2, *s.shape[1:], seed=5 + j))
        for j, s in enumerate(sources)
    )
    constraints = noise(1, *size, seed=7), noise(2, *size, seed=8)
    return Analogy(sources, mapped, constraints, (0.5, 2.0))


def random_labeling(made: Analogy, seed: int = 0) -> Labeling:
    """Any label at every pixel, in patches of a few pixels, some of one label."""
    g = torch.Generator().manual_seed(seed)
    kinds, (h, w) = variants(made, mirrors=True), made.size
    labels = torch.zeros(h, w, 3, dtype=torch.long)
    for i, j in product(range(0, h, 3), range(0, w, 3)):
        number = int(torch.randint(len(kinds), (), generator=g))
        hv, wv = kinds[number].image.shape[1:]
        at = [int(torch.randint(n - 2, (), generator=g)) for n in (hv, wv)]
        labels[i : i + 3, j : j + 3] = torch.tensor([number, i - at[0], j - at[1]])
    return Labeling(labels, kinds)


def value(image: Tensor, row: int, col: int) -> Tensor:
    """The pixel of an image whose border goes on."""
    return image[:, min(max(row, 0), image.shape[1] - 1), min(max(col, 0), image.shape[2] - 1)]


def brute(made: Analogy, labeling: Labeling, K: float, N: int) -> dict[str, Tensor]:
    """All energies, pixel by pixel, from the formulas."""
    (h, w), labels, kinds = made.size, labeling.labels.tolist(), labeling.variants
    guide = made.guide()

    def shown(p: tuple[int, int], q: tuple[int, int], mapped: bool) -> Tensor:
        number, row, col = labels[p[0]][p[1]]
        kind = kinds[number]
        return value(kind.mapped if mapped else kind.image, q[0] - row, q[1] - col)

    def pair(p: tuple[int, int], q: tuple[int, int]) -> Tensor:
        return (shown(p, p, False) - shown(q, p, False)).norm() + (
            shown(p, q, False) - shown(q, q, False)
        ).norm()

    pixels = list(product(range(h), range(w)))
    out = {k: guide.new_zeros(h, w) for k in ("A", "label", "error")}
    out["right"], out["down"] = guide.new_zeros(h, w - 1), guide.new_zeros(h - 1, w)
    for i, j in pixels:
        if j + 1 < w:
            out["right"][i, j] = pair((i, j), (i, j + 1))
        if i + 1 < h:
            out["down"][i, j] = pair((i, j), (i + 1, j))
    for i, j in pixels:
        near = [(a, b) for a, b in pixels if abs(a - i) <= N and abs(b - j) <= N]
        for q in near:
            there = guide[:, q[0], q[1]]
            out["A"][i, j] += K * (shown(q, q, True) - there).square().sum()
            out["label"][i, j] += K * (shown((i, j), q, True) - there).square().sum()
            if (q[0], q[1] + 1) in near:
                out["error"][i, j] += out["right"][q]
            if (q[0] + 1, q[1]) in near:
                out["error"][i, j] += out["down"][q]
    out["error"] += out["A"]
    return out


@pytest.mark.parametrize(("K", "N", "seed"), [(0.7, 1, 0), (3.0, 2, 1)])
def test_energies_equal_their_definitions(K: float, N: int, seed: int) -> None:
    made = problem()
    labeling = random_labeling(made, seed)
    wanted = brute(made, labeling, K, N)
    right, down = analogy_costs.boundary(labeling)
    found = {
        "A": analogy_costs.agreement(made, labeling, K=K, N=N),
        "label": analogy_costs.label_agreement(made, labeling, K=K, N=N),
        "error": analogy_costs.match_error(made, labeling, K=K, N=N),
        "right": right,
        "down": down,
    }
    for name, values in found.items():
        torch.testing.assert_close(values, wanted[name], rtol=1e-9, atol=1e-9, msg=name)
    sums = analogy_costs.energy(made, labeling, K=K, N=N)
    pairs = wanted["right"].sum() + wanted["down"].sum()
    assert sums.exact == pytest.approx(float(wanted["A"].sum() + pairs))
    assert sums.minimised == pytest.approx(float(wanted["label"].sum() + pairs))


def test_windows_larger_than_the_output_hold_all_of_it() -> None:
    made = problem(size=(3, 4))
    labeling = random_labeling(made)
    wanted = brute(made, labeling, 1.0, 6)
    torch.testing.assert_close(analogy_costs.agreement(made, labeling, K=1.0, N=6), wanted["A"])
    torch.testing.assert_close(
        analogy_costs.label_agreement(made, labeling, K=1.0, N=6), wanted["label"]
    )
    torch.testing.assert_close(
        analogy_costs.match_error(made, labeling, K=1.0, N=6), wanted["error"]
    )


def test_render_and_source_field_agree_with_the_variants() -> None:
    made = problem()
    labeling = random_labeling(made, seed=2)
    field = labelings.source_field(labeling)
    texture = labelings.render(labeling, made.sources)
    assert torch.equal(texture, labelings.views(labeling)[0])
    assert torch.equal(texture, field.apply(list(made.sources)))
    number, row, col = field.source_map()[4, 5].tolist()
    assert torch.equal(texture[:, 4, 5], made.sources[number][:, row, col])


def test_placed_labels_show_the_positions_they_were_made_of() -> None:
    made = problem()
    kinds = variants(made)
    positions = torch.stack(
        [
            torch.randint(n, made.size, generator=torch.Generator().manual_seed(n))
            for n in (2, 12, 10)
        ],
        -1,
    )
    labeling = labelings.placed(positions, kinds)
    assert torch.equal(labelings.source_field(labeling).source_map(), positions)


def test_same_constraint_twice_is_one_of_twice_the_weight() -> None:
    s, q, c = noise(3, 9, 9), noise(1, 9, 9, seed=1), noise(1, 9, 9, seed=2)
    twice, heavy = Analogy((s,), ((q, q),), (c, c)), Analogy((s,), ((q,),), (c,), (2.0,))
    labels = torch.zeros(9, 9, 3, dtype=torch.long)
    sums = [
        analogy_costs.energy(p, Labeling(labels, variants(p)), K=1.0, N=2) for p in (twice, heavy)
    ]
    assert sums[0].exact == pytest.approx(sums[1].exact)


def test_labels_outside_their_variant_are_refused() -> None:
    made = problem()
    with pytest.raises(ValueError, match="leave their variant"):
        Labeling(torch.full((9, 11, 3), 1), variants(made))
    with pytest.raises(ValueError, match=r"name the variants 99\.\.99"):
        Labeling(torch.full((9, 11, 3), 99), variants(made))


S, Q, C = noise(3, 8, 9), noise(1, 8, 9), noise(1, 5, 6)
NAN = C * torch.nan


@pytest.mark.parametrize(
    ("sources", "mapped", "constraints", "weights", "message"),
    [
        ((S,), ((Q[:, :7],),), (C,), (), "mapped is 7x9 and its source 8x9"),
        ((S, S), ((Q,),), (C,), (), "mapped: 1 given for 2 sources"),
        ((S, S[:1]), ((Q,), (Q,)), (C,), (), "source: one has 1 channels and another 3"),
        ((S,), ((S,),), (C,), (), "mapped has 3 channels and its constraint 1"),
        ((S,), ((Q,),), (C, C), (), "mapped: a source has 1 for 2 constraints"),
        ((S,), ((Q, Q),), (C, C[:, 1:]), (), "constraint: one is 4x6 and another 5x6"),
        ((S,), ((Q,),), (NAN,), (), "constraint holds NaN"),
        ((S,), ((Q * torch.nan,),), (C,), (), "mapped holds NaN"),
        ((S * torch.nan,), ((Q,),), (C,), (), "source holds NaN"),
        ((S,), ((Q,),), (C,), (1.0, 2.0), "weights: 2 given for 1 constraints"),
        ((S,), ((Q,),), (C,), (0.0,), "weights=0.0 must be above 0"),
        ((), (), (C,), (), "none given"),
        ((S.float(),), ((Q,),), (C,), (), "beside torch.float32"),
    ],
)
def test_bad_problems_are_refused_in_a_sentence(
    sources: tuple[Tensor, ...],
    mapped: tuple[tuple[Tensor, ...], ...],
    constraints: tuple[Tensor, ...],
    weights: tuple[float, ...],
    message: str,
) -> None:
    with pytest.raises(ValueError, match=message):
        Analogy(sources, mapped, constraints, weights)


@pytest.mark.parametrize(("K", "N"), [(-1.0, 2), (float("nan"), 2), (1.0, 0)])
def test_bad_weights_and_windows_are_refused(K: float, N: int) -> None:
    made = problem()
    with pytest.raises(ValueError, match=r"must be at least"):
        analogy_costs.energy(made, random_labeling(made), K=K, N=N)


def test_matched_luminance_has_the_mean_and_deviation_of_the_other() -> None:
    image, like = 0.4 + 0.2 * noise(3, 20, 20), 0.3 + 0.1 * noise(3, 15, 10, seed=1)
    found, wanted = luminance(transfers.match_luminance(image, like)), luminance(like)
    assert float(found.mean()) == pytest.approx(float(wanted.mean()), abs=1e-3)
    assert float(found.std()) == pytest.approx(float(wanted.std()), rel=2e-2)
    flat = transfers.match_luminance(torch.full((1, 4, 4), 0.5), like[:1])
    assert bool(flat.isfinite().all())


def test_detail_of_a_picture_for_itself_is_that_picture() -> None:
    sharp = noise(3, 24, 20)
    low = detail.shrunk(sharp, (6, 5))
    made = detail.detail_problem(sharp, low, 4)
    torch.testing.assert_close(made.mapped[0][0], made.constraints[0])
    assert detail.detail_error(sharp, low, 4) == pytest.approx(0, abs=1e-12)
    assert detail.detail_error(sharp.clamp(max=0.9) + 0.1, low + 0.1, 4) < 0.1
    assert detail.sharpness_ratio(made.constraints[0], sharp) < 0.5


def test_back_projection_meets_the_small_picture_and_keeps_detail() -> None:
    sharp, low = 0.2 + 0.5 * noise(3, 24, 20), 0.3 + 0.3 * noise(3, 6, 5, seed=1)
    found = detail.back_projected(sharp, low, 4)
    assert detail.detail_error(found, low, 4) < 0.02 < detail.detail_error(sharp, low, 4)
    assert detail.sharpness_ratio(found, sharp) > 0.9


def test_bad_details_are_refused() -> None:
    with pytest.raises(ValueError, match="factor=1 must be above 1"):
        detail.detail_problem(S, S, 1)
    with pytest.raises(ValueError, match="sample is 8x9, less than factor=20"):
        detail.detail_problem(S, S, 20)
    with pytest.raises(ValueError, match="output is 8x9; factor=2 makes 16x18 of low"):
        detail.detail_error(S, S, 2)


def test_transfer_compares_lightness() -> None:
    made = transfers.transfer_problem(S, noise(3, 6, 7, seed=4), match=True)
    assert torch.equal(made.mapped[0][0][0], luminance(S))
    assert float(made.constraints[0].mean()) == pytest.approx(float(luminance(S).mean()), abs=0.02)
    blurred = transfers.transfer_problem(torch.ones(3, 9, 9), torch.ones(1, 6, 7), blur=1.5)
    torch.testing.assert_close(blurred.mapped[0][0], torch.ones(1, 9, 9))
    bold = transfers.transfer_problem(S, 0.4 + 0.1 * C, contrast=2.0).constraints[0]
    assert float(bold.std()) == pytest.approx(0.2 * float(C.std()))
    with pytest.raises(ValueError, match=r"contrast=0.0 must"):
        transfers.transfer_problem(S, S, contrast=0.0)
    with pytest.raises(ValueError, match=r"blur=-1.0 must be at least 0"):
        transfers.transfer_problem(S, S, blur=-1.0)


def painted(h: int, w: int) -> Tensor:
    """Three regions: left red, right green, below blue."""
    maps = torch.zeros(3, h, w, dtype=torch.float64)
    maps[0, :, : w // 2], maps[1, :, w // 2 :] = 1, 1
    maps[:, 2 * h // 3 :] = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)[:, None, None]
    return maps


def test_soft_edges_and_uneven_colours_snap_to_the_palette() -> None:
    clean, wanted = painted(30, 24), painted(24, 30)
    soft = torch.nn.functional.avg_pool2d(wanted[None], 3, 1, 1, count_include_pad=False)[0]
    soft = (soft * 0.97 + 0.01 * noise(3, 24, 30)).clamp(0, 1)
    found = region_maps.snapped(clean, soft)
    assert torch.equal(found.mapped, clean)
    assert len(found.palette) == 3
    assert found.changed[0] == 0
    assert found.changed[1] > 500
    assert float((found.constraint != wanted).any(0).double().mean()) < 0.05


def test_colours_that_the_mapped_source_has_not_are_listed() -> None:
    strange = painted(30, 24)
    strange[:, :10, :10] = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)[:, None, None]
    with pytest.raises(ValueError, match=r"colours that mapped has not: \(255, 255, 0\)"):
        region_maps.snapped(painted(30, 24), strange)


def test_bad_maps_are_refused() -> None:
    with pytest.raises(ValueError, match="mapped has 3 channels and constraint 1"):
        region_maps.snapped(S, C)
    with pytest.raises(ValueError, match="no map of regions"):
        region_maps.snapped(noise(3, 60, 60), noise(3, 60, 60))
    with pytest.raises(ValueError, match=r"near=0.0 and share=0.002"):
        region_maps.snapped(S, S, near=0.0)
