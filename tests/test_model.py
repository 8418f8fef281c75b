"""The texture model: one label space, the M-step, coherence, masks, soft constraints."""

import doctest
from collections.abc import Callable

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex import model as model_module
from torchtex.controls import Guide, SoftConstraint
from torchtex.features import Feature, Gradients, Pixels, Wavelets
from torchtex.label_spaces import LabelSpace, label_space, strips
from torchtex.matching import Chunked, Clustered, Exact
from torchtex.model import Search, exact_search, fast_search, texture_model
from torchtex.neighborhoods import Grid, falloff

SEARCHES = [
    exact_search(),
    fast_search(),
    Search(Chunked(), candidates=3),
    Search(Clustered(clusters=9, probes=1, least=0), dimensions=5, candidates=4, coherence=True),
]


def identity(space: LabelSpace, sites: Tensor, which: int = 0) -> Tensor:
    return space.at(torch.cat([torch.full((len(sites), 1), which), sites], 1))


def test_labels_count_the_windows_and_know_their_places() -> None:
    space = label_space([(10, 12), (7, 20), (9, 9)], 8)
    assert len(space) == 3 * 5 + 2 * 2
    assert torch.equal(space.at(space.positions), torch.arange(len(space)))
    outside = torch.tensor([[0, -1, 0], [0, 3, 0], [0, 0, 5], [1, 0, 0], [2, 2, 0], [3, 0, 0]])
    assert space.at(outside).tolist() == [-1] * 6
    assert space.at(torch.tensor([[2, 1, 1]])).tolist() == [18]


def test_masked_windows_have_no_label() -> None:
    mask = torch.ones(10, 12, dtype=torch.bool)
    mask[5, 6] = False
    space = label_space([(10, 12)], 4, [mask])
    for _, row, col in space.positions.tolist():
        assert mask[row : row + 4, col : col + 4].all()
    assert len(space) == 7 * 9 - 16
    assert len(label_space([(10, 12), (10, 12)], 4, [mask, None])) == 7 * 9 - 16 + 7 * 9


def test_strips_are_the_windows_of_every_exemplar() -> None:
    images = [noise(3, 10, 12), noise(3, 7, 9, seed=1), noise(3, 5, 5, seed=2)]
    space = label_space([(z.shape[1], z.shape[2]) for z in images], 5)
    whole = [Grid(z.shape[1], z.shape[2], 5, 1).gather(z) for z in images]
    table = strips(images, space, 5)
    assert torch.equal(table.patches(torch.arange(len(space))), torch.cat(whole))


@pytest.mark.parametrize("periodic", [False, True])
def test_exact_match_is_the_nearest_by_direct_distances(periodic: bool) -> None:
    z, x = stripes(16, 17, 2), noise(2, 12, 13, seed=1)
    grid = Grid(12, 13, 5, 2, periodic)
    model = texture_model([z], grid, search=exact_search())
    root = falloff(5).sqrt().flatten().repeat_interleave(2)
    table = torch.cdist(grid.gather(x) * root, Grid(16, 17, 5, 1).gather(z) * root)
    assert torch.equal(model.match(x), table.argmin(1))


@pytest.mark.parametrize("search", SEARCHES, ids=repr)
@pytest.mark.parametrize("feature", [Pixels(), Gradients(), Wavelets(mode="window")], ids=repr)
def test_an_old_label_stays_unless_the_new_one_is_strictly_nearer(
    search: Search, feature: Feature
) -> None:
    z, x = stripes(20, 22), noise(3, 16, 16, seed=1)
    model = texture_model([z], Grid(16, 16, 8, 3), feature=feature, search=search)
    old = torch.randint(len(model.space), (16,), generator=torch.Generator().manual_seed(2))
    new = model.match(x, old)
    before, after = (model.energy(labels).distances(x) for labels in (old, new))
    assert (after <= before).all()
    assert (after < before)[new != old].all()
    again = model.match(x, new)
    assert (model.energy(again).distances(x) <= after).all()


def test_equal_keys_do_not_change_a_label() -> None:
    z = stripes(8, 8, 1).repeat(1, 2, 2)
    model = texture_model([z], Grid(8, 8, 8, 8), search=exact_search())
    equal = identity(model.space, torch.tensor([[0, 0], [0, 8], [8, 0], [8, 8]]))
    for label in equal:
        assert torch.equal(model.match(z[:, :8, :8], label[None]), label[None])


@pytest.mark.parametrize("periodic", [False, True])
def test_coherent_candidates_are_the_shifted_labels_of_the_neighbors(periodic: bool) -> None:
    grid = Grid(16, 16, 4, 4, periodic)
    space_side = 40
    model = texture_model([noise(1, space_side, space_side)], grid, search=fast_search())
    start = torch.tensor([12, 9])
    labels = identity(model.space, grid.sites + start)
    found = model._coherent(labels).view(*grid.shape, 4)
    inner = found[1:-1, 1:-1]
    expected = labels.view(grid.shape)[1:-1, 1:-1, None].expand_as(inner)
    assert torch.equal(inner, expected)
    wrapped = model.space.positions[found[0, 0]]  # above site (0, 0) lies the last row
    if periodic:
        assert wrapped[0].tolist() == [0, 12 + 16, 9]
        assert wrapped[2].tolist() == [0, 12, 9 + 16]


def test_several_exemplars_are_one_label_space() -> None:
    first, second = noise(2, 20, 14), noise(2, 13, 25, seed=1)
    grid = Grid(12, 12, 4, 2)
    for which, z in enumerate((first, second)):
        model = texture_model([first, second], grid, search=exact_search())
        labels = model.match(z[:, :12, :12].clone())
        assert torch.equal(labels, identity(model.space, grid.sites, which))


def test_masks_keep_labels_away_even_with_coherence() -> None:
    z = stripes(24, 24, 1)
    mask = torch.ones(24, 24, dtype=torch.bool)
    mask[8:14, 6:11] = False
    model = texture_model([z], Grid(20, 20, 5, 2), masks=[mask], search=fast_search())
    labels = None
    for seed in range(3):
        labels = model.match(noise(1, 20, 20, seed=seed), labels)
        for _, row, col in model.space.positions[labels].tolist():
            assert mask[row : row + 5, col : col + 5].all()


def test_completeness_spreads_labels_over_the_exemplar() -> None:
    z, x = stripes(24, 24, 1, seed=1), torch.full((1, 24, 24), 0.5, dtype=torch.float64)
    grid = Grid(24, 24, 6, 2)
    plain = texture_model([z], grid).match(x + 0.01 * noise(1, 24, 24))
    complete = texture_model([z], grid, completeness=50.0).match(x + 0.01 * noise(1, 24, 24))
    assert len(complete.unique()) >= len(plain.unique())


def test_a_heavy_guide_decides_the_match() -> None:
    z = noise(1, 20, 20)
    side = torch.zeros(1, 20, 20, dtype=torch.float64)
    side[:, :, 10:] = 1
    grid = Grid(12, 12, 4, 2)
    for wanted in (0.0, 1.0):
        guide = Guide([side], torch.full((1, 12, 12), wanted, dtype=torch.float64), 1e3)
        model = texture_model([z], grid, guides=[guide], search=exact_search())
        cols = model.space.positions[model.match(noise(1, 12, 12, seed=2))][:, 2]
        assert (cols >= 10).all() if wanted else (cols <= 6).all()


@pytest.mark.parametrize("weight", [0.0, 0.4, 30.0])
def test_a_full_soft_constraint_is_matched_exactly(weight: float) -> None:
    z, x, t = stripes(16, 17, 2), noise(2, 12, 13, seed=1), noise(2, 12, 13, seed=2)
    grid = Grid(12, 13, 5, 2)
    model = texture_model([z], grid, search=exact_search())
    pull = SoftConstraint(t, torch.full((12, 13), 0.5, dtype=torch.float64))
    root = falloff(5).sqrt().flatten().repeat_interleave(2)
    keys = Grid(16, 17, 5, 1).gather(z) * root
    cost = torch.cdist(grid.gather(x) * root, keys).square()
    cost = cost + 0.5 * weight * torch.cdist(grid.gather(t) * root, keys).square()
    assert torch.equal(model.match(x, None, [(weight, pull)]), cost.argmin(1))


def test_a_half_soft_constraint_never_makes_the_modified_cost_worse() -> None:
    z, x, t = stripes(16, 17, 2), noise(2, 12, 13, seed=1), noise(2, 12, 13, seed=2)
    grid = Grid(12, 13, 5, 2)
    confidence = torch.zeros(12, 13, dtype=torch.float64)
    confidence[:, :7] = 2
    model = texture_model([z], grid, search=fast_search())
    root = falloff(5).sqrt().flatten().repeat_interleave(2)
    held = grid.gather(confidence[None]).repeat_interleave(2, 1)

    def cost(labels: Tensor) -> Tensor:
        patches = Grid(16, 17, 5, 1).gather(z)[labels]
        apart = (grid.gather(x) - patches).square() + held * (grid.gather(t) - patches).square()
        return (apart * root.square()).sum(1)

    old = torch.randint(len(model.space), (len(grid),), generator=torch.Generator().manual_seed(2))
    new = model.match(x, old, [(1.0, SoftConstraint(t, confidence))])
    assert (cost(new) <= cost(old) + 1e-12).all()
    assert (cost(new) < cost(old) - 1e-3).any()


def test_reduced_keys_of_a_smooth_exemplar_lose_little() -> None:
    z, x = stripes(30, 30), stripes(24, 24, seed=4)
    grid = Grid(24, 24, 8, 4)
    exact = texture_model([z], grid, search=exact_search())
    fast = texture_model([z], grid, search=Search(Exact(), dimensions=12, candidates=4))
    best = exact.energy(exact.match(x)).distances(x).sum()
    assert fast.axes is not None
    assert fast.keys.shape == (len(fast.space), 12)
    assert fast.energy(fast.match(x)).distances(x).sum() < 1.2 * best


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda z: texture_model([z], Grid(20, 20, 8, 4), r=0.0), r"r=0.0 must lie in \(0, 2\]"),
        (lambda z: texture_model([z], Grid(20, 20, 8, 4), r=2.5), "r=2.5"),
        (lambda z: texture_model([z], Grid(20, 20, 8, 4), completeness=-1.0), "completeness=-1"),
        (lambda z: texture_model([z], Grid(40, 40, 20, 4)), "no whole unmasked window of size=20"),
        (
            lambda z: texture_model(
                [z], Grid(20, 20, 8, 4), masks=[torch.zeros(16, 16, dtype=torch.bool)]
            ),
            "no whole unmasked window",
        ),
        (lambda z: Search(Exact(), candidates=0), "candidates=0"),
        (lambda z: Search(Exact(), dimensions=0), "dimensions=0"),
    ],
)
def test_wrong_settings_say_what_is_wrong(make: Callable[[Tensor], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(noise(1, 16, 16))


def test_the_examples_run() -> None:
    assert doctest.testmod(model_module).failed == 0
