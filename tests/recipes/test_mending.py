"""Mended seams: they never get worse, things stay, pixels are those of the exemplars."""

import pytest
import torch
from conftest import noise
from torch import Tensor
from torch.nn.functional import interpolate

from torchtex.cuts.seams import patch_views, present_seams
from torchtex.recipes.carried import itself
from torchtex.recipes.graphcut import Random, graphcut
from torchtex.recipes.mended_canvas import MendedCanvas, edges_of, views_of
from torchtex.recipes.mending import Mending, mended
from torchtex.recipes.montage import Montage, Stage
from torchtex.sources import copied

SMALL = Mending(12, window=20, place=6)


def rough(z: Tensor, size: tuple[int, int] = (48, 40), seed: int = 0) -> Montage:
    return graphcut(z, size, placement=Random(), refine=0, seed=seed)


def cost(positions: Tensor, zs: list[Tensor], periodic: bool = False) -> float:
    views = views_of(positions, zs, periodic=periodic)
    if periodic:
        views = torch.cat([views, views[:, :, :1]], 2)
        views = torch.cat([views, views[..., :1]], 3)
        across, down = present_seams(views, gradient=True)
        return float(across[:-1].sum() + down[:, :-1].sum())
    return float(sum(costs.sum() for costs in present_seams(views, gradient=True)))


def test_pieces_may_be_larger_than_what_was_compared() -> None:
    z = interpolate(noise(3, 12, 12)[None], (48, 48), mode="bicubic")[0].clamp(0, 1)
    whole = itself([z], 0)
    rows = whole.field.positions[0].view(6, 8, 6, 8, 3).movedim(2, 1).reshape(36, 8, 8, 3)
    order = torch.randperm(36, generator=torch.Generator().manual_seed(0))
    places = rows[order].view(6, 6, 8, 8, 3).movedim(2, 1).reshape(48, 48, 3)
    field = copied(places, [(48, 48)])
    made = Montage(field.apply([z]), field, torch.zeros(48, 48, dtype=torch.long), 0.0, 0, {})
    done = mended(made, [z], Mending(30, window=20, place=6))
    spans = []
    for number in range(1, int(done.patches.max()) + 1):
        found = (done.patches == number).nonzero()
        if len(found):
            spans.append(int((found.amax(0) - found.amin(0)).max()) + 1)
    assert 20 < max(spans) <= 20 + 2 * 5


def test_views_of_copies_are_those_of_the_exemplar() -> None:
    z = noise(3, 12, 14)
    made = itself([z], 0)
    views = views_of(made.field.positions[0], [z])
    assert torch.equal(views, patch_views(z))
    # two parts of it side by side: beyond the seam each goes on as in the exemplar
    places = made.field.positions[0]
    joined = torch.cat([places[:, :5], places[:, 8:]], 1)
    views = views_of(joined, [z])
    assert torch.equal(views[2, :, :, 4], z[:, :, 5])
    assert torch.equal(views[4, :, :, 5], z[:, :, 7])


@pytest.mark.parametrize("turn", [1, 2, 3])
def test_views_follow_turned_pieces(turn: int) -> None:
    z = noise(1, 12, 12)
    places = itself([z], 0).field.positions[0]
    turned = places.rot90(turn, (0, 1))
    joined = torch.cat([turned[:, :5], places[:, 8:]], 1)
    views = views_of(joined, [z])
    apart = (joined[:, 5] - joined[:, 4]).abs().amax(1) > 1  # not neighbours by chance
    assert int(apart.sum()) > 6
    assert torch.equal(views[2, :, apart, 4], z.rot90(turn, (1, 2))[:, apart, 5])


@pytest.mark.parametrize("periodic", [False, True])
def test_a_canvas_measures_all_seams(periodic: bool) -> None:
    z = noise(3, 24, 24)
    made = rough(z)
    places = made.field.positions[0]
    canvas = MendedCanvas(
        views_of(places, [z], periodic=periodic), places, made.patches,
        torch.full_like(made.patches, -1), periodic,
    )  # fmt: skip
    whole = canvas.seams.clone()
    assert float(whole.sum()) == pytest.approx(cost(places, [z], periodic))
    canvas.seams.fill_(torch.nan)
    for top in range(0, 48, 8):
        for left in range(0, 40, 8):
            canvas.measure(top, left, (8, 8))
    assert torch.allclose(canvas.seams, whole)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("mirrors", [False, True])
def test_seams_never_get_worse_and_pixels_are_read(periodic: bool, mirrors: bool) -> None:
    z = noise(3, 24, 26)
    made = rough(z)
    done = mended(made, [z], Mending(12, 20, 6, mirrors=mirrors), periodic=periodic, seed=2)
    assert torch.equal(done.apply(z), done.texture)
    assert done.settings["seams"] < done.settings["seams_before"]
    # counted on the way, and again from the sources, but for what narrow pieces show beyond them
    left = cost(done.field.positions[0], [z], periodic)
    assert left == pytest.approx(done.settings["seams"], rel=0.1)


def test_nothing_is_done_to_what_has_no_seams() -> None:
    z = noise(3, 24, 24)
    made = itself([z], 0)
    assert torch.equal(mended(made, [z], SMALL).texture, z)
    rough_one = rough(z)
    none = mended(rough_one, [z], Mending(0))
    assert torch.equal(none.texture, rough_one.texture)
    assert none.settings["mended"] == 0


def test_things_that_fit_stay() -> None:
    z = noise(3, 32, 32)
    places = itself([z], 0).field.positions[0]
    held = torch.full((32, 32), -1)
    held[8:20, 8:20] = 4  # in its own place: it fits
    cut = places.clone()
    cut[:, 24:] = places[:, :8]
    made = Montage(z, copied(cut, ((32, 32),)), torch.zeros(32, 32).long(), 0.0, 0, {})
    done = mended(made, [z], SMALL, held=held)
    assert torch.equal(done.field.positions[0][held == 4], places[held == 4])


def test_taste_decides_what_is_chosen() -> None:
    z = noise(3, 40, 40)
    left = torch.ones(40, 40, dtype=torch.float64)
    left[:, :20] = 0.01
    made = rough(z, (64, 64))
    first, second = (
        mended(made, [z], Mending(20, 16, 6), taste=[taste]) for taste in (left, left.flip(1))
    )
    assert not torch.equal(first.texture, second.texture)
    assert torch.equal(first.apply(z), first.texture)


def test_levels_are_evened_out() -> None:
    z = torch.cat([torch.zeros(1, 16, 8), torch.full((1, 16, 8), 0.4)], 2).double()
    places = itself([z], 0).field.positions[0]
    joined = torch.cat([places[:, :6], places[:, 10:]], 1)
    made = Montage(z[..., :12], copied(joined, ((16, 16),)), joined[..., 0], 0.0, 0, {})
    done = mended(made, [z], Mending(0), poisson=True)
    assert float(done.texture.max() - done.texture.min()) < 1e-3
    assert float(done.apply(z).max()) > 0.39


def test_borders_of_numbers() -> None:
    numbers = torch.zeros(5, 5, dtype=torch.long)
    numbers[2, 2] = 1
    assert edges_of(numbers)[1:4, 1:4].all()
    assert int(edges_of(numbers).sum()) == 9


def test_steps_are_told_and_the_seed_repeats() -> None:
    z, told = noise(1, 24, 24), list[Stage]()
    made = rough(z)
    first = mended(made, [z], SMALL, seed=3, on_step=told.append)
    assert [stage.done for stage in told] == sorted(stage.done for stage in told)
    assert torch.equal(first.texture, mended(made, [z], SMALL, seed=3).texture)


@pytest.mark.usefixtures("unchecked")
def test_bad_input_is_refused() -> None:
    for options, words in (
        ({"count": -1}, "count=-1"),
        ({"place": 3}, "place=3"),
        ({"window": 8}, "window=8"),
        ({"spread": -0.5}, "spread=-0.5"),
    ):
        with pytest.raises(ValueError, match=words):
            Mending(**options)
