"""Constrained synthesis: the energy never rises, is what it is said to be, and finds copies."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise, product

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex.cuts.mincut import OrTools, PyMaxflow, grid_edges
from torchtex.recipes import cms as module
from torchtex.recipes.analogy import Analogy
from torchtex.recipes.analogy_costs import energy, label_agreement, match_error
from torchtex.recipes.cms import cms
from torchtex.recipes.cms_canvas import Canvas, decided
from torchtex.recipes.cms_search import Improvement, Prospects
from torchtex.recipes.labelings import Labeling, render, variants, views
from torchtex.recipes.montage import Stage


def numbers(h: int, w: int, slope: float) -> Tensor:
    """A map of two regions, with a slanted border."""
    row = torch.arange(h, dtype=torch.float64)[:, None]
    col = torch.arange(w, dtype=torch.float64)[None]
    return (row > h / 2 + slope * (col - w / 2)).double()[None]


def painting() -> Analogy:
    """Stripes above, noise below; the constraint has another border."""
    mapped = numbers(26, 32, 0.1)
    source = torch.where(mapped > 0, stripes(26, 32), 0.5 * noise(3, 26, 32, seed=1))
    return Analogy.of(source, mapped, numbers(30, 24, -0.4))


def several() -> Analogy:
    """Two sources of different size, two constraints."""
    sources = noise(3, 12, 15, seed=1), stripes(16, 11)
    mapped = tuple((s[:1] * 0.7, s[1:]) for s in sources)
    constraints = noise(1, 14, 13, seed=3), noise(2, 14, 13, seed=4)
    return Analogy(sources, mapped, constraints, (1.0, 0.5))


PROBLEMS = [painting, several]


@pytest.mark.parametrize("make", PROBLEMS)
@pytest.mark.parametrize("mirrors", [False, True])
@pytest.mark.parametrize("screened", [False, True])
def test_energy_falls_with_every_move_and_equals_a_count_from_scratch(
    make: Callable[[], Analogy], mirrors: bool, screened: bool
) -> None:
    problem = make()
    result = cms(
        problem, K=0.5, N=2, apart=4, history=3, tolerance=0.5, mirrors=mirrors, seed=3,
        screened=screened,
    )  # fmt: skip
    energies = [move.energy for move in result.moves]
    assert all(after < before for before, after in pairwise(energies))
    assert energies[-1] == pytest.approx(result.energies.minimised, rel=1e-9)
    again = energy(problem, result.labeling, K=0.5, N=2)
    assert again == result.energies


def canvas_of(problem: Analogy, K: float) -> Canvas:
    return Canvas(problem, variants(problem), K, 2, PyMaxflow())


def runner(canvas: Canvas) -> module._Run:
    return module._Run(canvas, 3, 5, torch.Generator().manual_seed(0), None)


@pytest.mark.parametrize("make", PROBLEMS)
@pytest.mark.parametrize("way", ["screened", "as_in_the_paper"])
def test_all_that_is_kept_between_moves_equals_a_count_from_scratch(
    make: Callable[[], Analogy], way: str
) -> None:
    problem, checked = make(), 0
    canvas = canvas_of(problem, 0.8)
    run = runner(canvas)

    def step(_: Stage) -> None:
        nonlocal checked
        if not canvas.full:
            return
        labeling = Labeling(canvas.labels, canvas.variants)
        whole = energy(problem, labeling, K=0.8, N=2)
        assert canvas.energy == pytest.approx(whole.minimised, rel=1e-8)
        close = {"rtol": 1e-8, "atol": 1e-8}
        canvas.refresh()
        torch.testing.assert_close(
            canvas.error, match_error(problem, labeling, K=0.8, N=2), **close
        )
        agreement = label_agreement(problem, labeling, K=0.8, N=2)
        torch.testing.assert_close(canvas.unary, agreement, **close)
        kept = canvas.shown.permute(1, 2, 0).view(5, -1, *canvas.size)
        assert torch.equal(kept, views(labeling))
        around = canvas.right + canvas.right.roll(1, 1) + canvas.down + canvas.down.roll(1, 0)
        torch.testing.assert_close(canvas.stake, agreement + around, **close)
        checked += 1

    run.on_step = step
    getattr(run, way)(0.5, 4, 60)
    assert checked >= 4


def test_search_equals_the_improvement_by_its_definition() -> None:
    problem, K, N = several(), 0.8, 2
    canvas = canvas_of(problem, K)
    runner(canvas).as_in_the_paper(1e9, 1, 0)
    search = Improvement.of(canvas.variants, K, N)
    for place in ((0, 0), (7, 6), (13, 2)):
        costs = search(place, canvas.guide, canvas.image, canvas.known)
        for number, i, j in ((0, 3, 4), (1, 0, 0), (6, 15, 10)):
            label = number, place[0] - i, place[1] - j
            kind, total = canvas.variants[number], 0.0
            for a, b in product(range(-N, N + 1), repeat=2):
                p = place[0] + a, place[1] + b
                if not (0 <= p[0] < 14 and 0 <= p[1] < 13):
                    continue
                h, w = kind.image.shape[1:]
                r, c = min(max(p[0] - label[1], 0), h - 1), min(max(p[1] - label[2], 0), w - 1)
                total += K * float(
                    (kind.mapped[:, r, c] - canvas.guide[:, p[0], p[1]]).square().sum()
                )
                total += float((kind.image[:, r, c] - canvas.image[:, p[0], p[1]]).square().sum())
            assert float(costs[number][i, j]) == pytest.approx(total, rel=1e-8)


def test_prospects_put_the_label_first_that_gains_most() -> None:
    problem = painting()
    canvas = canvas_of(problem, 0.8)
    runner(canvas).screened(1e9, 1, 0)
    generator = torch.Generator().manual_seed(1)
    prospects = Prospects(canvas.variants, canvas.guide, 0.8, 2, generator)
    for place in prospects.places(canvas.unary, 10):
        prospects.search(place, 5, canvas.unary)
    promised = [label for _, _, label in sorted(prospects.waiting)]
    _, label = prospects.best(canvas.unary)
    assert label in promised[:10]
    assert len(prospects.waiting) == 49


def test_a_move_is_the_best_one_of_the_pixels_that_are_offered() -> None:
    problem = several()
    for seed in range(6):
        canvas = canvas_of(problem, 0.3)
        module._Run(canvas, 3, 5, torch.Generator().manual_seed(seed), None).screened(1e9, 1, 3)
        before, labels = canvas.energy, canvas.labels.clone()
        label = (seed, 1 - seed, seed - 3)
        changed = canvas.expand(label)
        best = before
        mine = torch.zeros(canvas.labels.shape[:2], dtype=torch.bool)
        mine.view(-1)[changed] = True
        for flat in range(mine.numel()):  # one pixel more or less is no better
            trial = mine.clone()
            trial.view(-1)[flat] ^= True
            place = divmod(flat, mine.shape[1])
            shape = canvas.variants[seed].image.shape[1:]
            inside = all(0 <= p - o < n for p, o, n in zip(place, label[1:], shape, strict=True))
            if not inside:
                continue
            tried = torch.where(trial[..., None], torch.tensor(label), labels)
            costs = energy(problem, Labeling(tried, canvas.variants), K=0.3, N=2)
            best = min(best, costs.minimised)
        assert canvas.energy <= best + 1e-9


@pytest.mark.parametrize("solver", [PyMaxflow(), OrTools()])
def test_the_cut_is_the_minimum(solver: PyMaxflow | OrTools) -> None:
    every = torch.tensor(list(product((False, True), repeat=12)))
    pairs = grid_edges(3, 4, 3, 2).T
    for seed in range(20):
        gain, caps = 3 * (noise(12, seed=seed) - 0.5), noise(len(pairs[0]), seed=seed + 50)
        caps = torch.where(caps < 0.2, 0, caps)
        cut = ~every[:, pairs[0]] & every[:, pairs[1]]
        costs = (gain * every).sum(1) + (caps * cut).sum(1)
        found = decided(gain, pairs, caps, solver)
        own = costs[(every == found).all(1)]
        assert float(own) == pytest.approx(float(costs.min()), abs=1e-9)


@pytest.mark.parametrize("screened", [False, True])
def test_no_masked_pixel_is_copied(screened: bool) -> None:
    mask = noise(26, 32, seed=8) > 0.4
    problem = replace(painting(), masks=(mask,))
    result = cms(
        problem, K=0.5, N=2, apart=2, history=3, tolerance=0.5, mirrors=True, screened=screened
    )
    _, row, col = result.montage.source_map.unbind(-1)
    assert bool(mask[row, col].all())
    free = cms(painting(), K=0.5, N=2, apart=2, history=3, tolerance=0.5, screened=screened)
    _, row, col = free.montage.source_map.unbind(-1)
    assert not bool(mask[row, col].all())


def test_an_exemplar_is_its_own_analogy() -> None:
    z = noise(3, 24, 20)
    result = cms(Analogy.of(z, z, z), K=1.0, N=2, tolerance=0.0)
    assert torch.equal(result.texture, z)
    assert len(result.labeling.labels.flatten(0, 1).unique(dim=0)) == 1
    assert result.energies.minimised == 0


def test_a_turned_exemplar_is_found_only_with_turns() -> None:
    z = noise(3, 16, 14)
    turned = z.rot90(1, (1, 2)).contiguous()
    assert torch.equal(cms(Analogy.of(z, z, turned), N=2, tolerance=0.0).texture, turned)
    flat = cms(Analogy.of(z, z, turned), N=2, tolerance=1.0, apart=4, turns=False)
    assert not torch.equal(flat.texture, turned)
    mirrored = z.flip(2).contiguous()
    found = cms(Analogy.of(z, z, mirrored), N=2, tolerance=0.0, turns=False, mirrors=True)
    assert torch.equal(found.texture, mirrored)


def test_regions_hold_what_their_number_asks_for() -> None:
    problem = painting()
    result = cms(problem, K=0.5, N=2, apart=4, history=3, tolerance=0.5)
    shown = render(result.labeling, [m[0] for m in problem.mapped])
    assert float((shown != problem.constraints[0]).double().mean()) < 0.06


def test_the_source_with_the_right_mapping_is_taken() -> None:
    dark, light = 0.3 * noise(3, 16, 16), 0.7 + 0.3 * noise(3, 16, 16, seed=1)
    zeros, ones = torch.zeros(1, 16, 16).double(), torch.ones(1, 16, 16).double()
    problem = Analogy((dark, light), ((zeros,), (ones,)), (torch.ones(1, 20, 20).double(),))
    result = cms(problem, K=2.0, N=2, apart=4, history=3, tolerance=0.5)
    assert bool((result.montage.source_map[..., 0] == 1).all())


def test_texture_is_rendered_from_the_field_and_patches_are_labels() -> None:
    problem = several()
    result = cms(problem, K=0.5, N=2, apart=4, history=3, tolerance=0.5, mirrors=True)
    montage = result.montage
    assert torch.equal(montage.apply(list(problem.sources)), result.texture)
    labels = result.labeling.labels.flatten(0, 1)
    assert int(montage.patches.max()) + 1 == len(labels.unique(dim=0)) > 3
    assert len(montage.patches.unique()) == int(montage.patches.max()) + 1
    assert montage.report()["settings"]["tolerance"] == 0.5


def test_same_seed_same_pixels_for_any_threads() -> None:
    first = cms(several(), K=0.5, N=2, apart=4, history=3, tolerance=0.5, seed=5)
    torch.set_num_threads(2)
    second = cms(several(), K=0.5, N=2, apart=4, history=3, tolerance=0.5, seed=5)
    assert torch.equal(first.labeling.labels, second.labeling.labels)
    assert first.moves == second.moves


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept(dtype: torch.dtype) -> None:
    z = noise(1, 12, 12, dtype=dtype)
    result = cms(Analogy.of(z, z, z[:, :1, :7]), K=0.0, N=3, max_moves=0)
    assert result.texture.dtype == dtype
    assert result.texture.shape == (1, 1, 7)


def test_energy_is_kept_exactly_enough_in_single_precision() -> None:
    s, q, c = (noise(k, 14, 15, dtype=torch.float32, seed=i) for i, k in enumerate((3, 1, 1)))
    result = cms(Analogy.of(s, q, c), K=20.0, N=3, apart=4, history=3)
    assert result.moves[-1].energy == pytest.approx(result.energies.minimised, rel=1e-5)


def test_no_pixel_is_left_without_a_label_however_few_moves_are_allowed() -> None:
    problem = Analogy.of(noise(3, 6, 5), noise(1, 6, 5), noise(1, 30, 31))
    result = cms(problem, K=1.0, N=2, apart=2, max_moves=0)
    assert result.moves[-1].energy == pytest.approx(result.energies.minimised, rel=1e-9)


def test_progress_is_told_and_can_cancel() -> None:
    stages: list[Stage] = []
    cms(painting(), K=0.5, N=2, apart=4, history=3, tolerance=1.0, on_step=stages.append)
    assert all(a.done <= b.done for a, b in pairwise(stages))
    assert all(word in stages[-1].detail for word in ("E'", "moves", "worst at"))

    def cancel(_: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cms(painting(), on_step=cancel)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"K": -1.0}, r"K=-1.0 must be at least 0"),
        ({"N": 0}, "N=0 must be at least 1"),
        ({"candidates": 0}, "candidates=0 must be at least 1"),
        ({"apart": 0}, "apart=0 must be at least 1"),
        ({"history": 0}, "history=0 must be at least 1"),
        ({"tolerance": -1.0}, r"tolerance=-1.0 must be at least 0"),
        ({"max_moves": -1}, "max_moves=-1 must be at least 0"),
        ({"seed": -1}, "seed=-1 must lie in"),
    ],
)
def test_bad_options_are_refused(options: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cms(painting(), **options)
