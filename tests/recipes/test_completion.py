"""Completion: what is far from holes stays, what is new is copied, every search and order works."""

import pytest
import torch
from conftest import noise, spots, stripes
from torch import Tensor

from torchtex.qtp import Qtp
from torchtex.recipes.completion import Order, complete
from torchtex.recipes.montage import Stage
from torchtex.recipes.patch_finders import Search, finder_of


def holes(kind: str, size: tuple[int, int] = (44, 48)) -> Tensor:
    mask = torch.zeros(size, dtype=torch.bool)
    if kind == "square":
        mask[14:26, 16:30] = True
    elif kind == "corner":
        mask[:9, :10] = True
    elif kind == "speckled":
        mask[10:22, 12:26] = noise(12, 14, seed=3) > 0.5
    else:
        mask[5:9, 30:40] = True
        mask[-6:, 2:12] = True
    return mask


@pytest.mark.parametrize("kind", ["square", "corner", "speckled", "two"])
@pytest.mark.parametrize("order", ["scan", "confidence"])
@pytest.mark.parametrize("channels", [1, 4])
def test_new_pixels_are_copies_of_known_ones(kind: str, order: Order, channels: int) -> None:
    image, mask = stripes(44, 48, channels), holes(kind)
    done = complete(image, mask, patch=10, rim=3, order=order, poisson=False)
    assert torch.equal(done.apply(image), done.texture)
    which, row, col = done.source_map.unbind(-1)
    assert not which.any()
    assert not mask[row, col].any()
    assert bool((done.patches[mask] > 0).all())
    far = torch.nn.functional.max_pool2d(mask[None].double(), 7, 1, 3)[0] == 0
    assert not done.patches[far].any()
    assert torch.equal(done.texture[:, far], image[:, far])


def test_without_a_rim_known_pixels_keep_their_bits() -> None:
    image, mask = stripes(44, 48), holes("two")
    for poisson in (False, True):
        done = complete(image, mask, patch=10, rim=0, poisson=poisson)
        assert torch.equal(done.texture[:, ~mask], image[:, ~mask])
        assert torch.equal(done.patches > 0, mask)


@pytest.mark.parametrize("search", ["exhaustive", "qtp", Qtp((60,), axes=None)])
def test_searches_agree_where_the_best_is_clear(search: Search) -> None:
    image, mask = stripes(44, 48), holes("square")
    image = image + 0.2 * noise(3, 1, 1)
    first = complete(image, mask, patch=12, poisson=False)
    other = complete(image, mask, patch=12, poisson=False, search=search)
    assert other.settings["energy"] <= 1.3 * first.settings["energy"]
    if search == "exhaustive":
        assert torch.equal(first.texture, other.texture)


def test_the_quick_search_finds_what_is_there_for_any_zone() -> None:
    z = noise(3, 40, 40)
    quick, full = (finder_of(kind, [z, z.flip(1)], [None, None], 12) for kind in ("qtp", "fft"))
    assert torch.equal(quick.places(), full.places())
    same = torch.ones(len(full.places()), dtype=z.dtype)
    for seed in range(6):
        zone = noise(3, 3, seed=seed).repeat_interleave(4, 0).repeat_interleave(4, 1) > 0.6
        zone[:4, :4] = True
        template = z.flip(1)[:, 7:19, 20:32] if seed % 2 else z[:, 3:15, 8:20]
        costs, found = quick(template, zone, same)
        wanted, everywhere = full(template, zone, same)
        assert found[costs.argmin()] == everywhere[wanted.argmin()]
        best = int(found[costs.argmin()])
        liked = torch.where(torch.arange(len(same)) == best + 5, 1e-9, same)
        assert int((quick(template, zone, liked)[1] == best + 5).sum()) == 1
        assert float(costs.min()) == pytest.approx(0.0, abs=1e-12)
    thin = torch.zeros(12, 12, dtype=torch.bool)
    thin[0] = True  # no cell is known whole
    costs, found = quick(z[:, 3:15, 8:20], thin, same)
    assert quick.places()[found[costs.argmin()]].tolist() == [0, 3, 8]


def test_a_pattern_is_continued() -> None:
    image = stripes(48, 48)
    mask = torch.zeros(48, 48, dtype=torch.bool)
    mask[18:30, 18:30] = True
    done = complete(image, mask, patch=16)
    error = (done.texture - image)[:, mask].square().mean().sqrt()
    assert float(error) < 0.12
    assert float(image[:, mask].std()) > 0.2


def test_what_was_laid_before_is_laid_less() -> None:
    dull = 0.45 + 0.1 * noise(1, 48, 20, seed=2)
    image = torch.cat([noise(1, 48, 60), dull], 2)
    mask = torch.zeros(48, 80, dtype=torch.bool)
    mask[10:38, 10:46] = True
    most, flat = [], []
    for fresh in (0.0, 4.0):
        done = complete(image, mask, patch=10, rim=0, fresh=fresh, detail=0.0, poisson=False)
        places = done.source_map[mask][:, 1:]
        most.append(int(places.unique(dim=0, return_counts=True)[1].max()))
        flat.append(float((places[:, 1] >= 60).double().mean()))
    assert most[1] < most[0]
    assert flat[1] < 0.8 * flat[0]


@pytest.mark.parametrize("search", ["exhaustive", "fft", "qtp"])
@pytest.mark.parametrize("order", ["scan", "confidence"])
@pytest.mark.parametrize("lively", [True, False])
def test_a_hole_gets_the_detail_of_its_surroundings(
    search: Search, order: Order, lively: bool
) -> None:
    rough, dull = noise(3, 64, 48), 0.5 + 0.1 * noise(3, 64, 48, seed=2)
    image = torch.cat([rough, dull] if lively else [dull, rough], 2)
    mask = torch.zeros(64, 96, dtype=torch.bool)
    mask[22:42, 14:34] = True
    steps = []
    for detail in (0.0, 4.0):
        done = complete(
            image, mask, patch=14, order=order, search=search, detail=detail, poisson=False
        )
        inner = done.texture[:, 23:41, 15:33]
        steps.append(
            float(inner.diff(dim=2).abs().mean() / image[:, :, :48].diff(dim=2).abs().mean())
        )
    assert 0.85 < steps[1] < 1.2
    assert abs(steps[1] - 1) <= abs(steps[0] - 1) + 0.05
    if lively:
        assert steps[0] < 0.8 * steps[1]


def test_detail_of_nothing_is_no_cost() -> None:
    image, mask = stripes(40, 40), torch.ones(40, 40, dtype=torch.bool)
    first = complete(image, mask, source=stripes(), patch=12, detail=0.0)
    assert torch.equal(complete(image, mask, source=stripes(), patch=12).texture, first.texture)
    flat, hole = torch.full((1, 40, 40), 0.5), holes("square", (40, 40))
    assert torch.equal(complete(flat, hole, patch=12).texture, flat)


def test_what_the_hole_holds_changes_nothing_and_threads_no_bit() -> None:
    image, mask = stripes(44, 48), holes("square")
    first = complete(image, mask, patch=10, tolerance=0.3, seed=5)
    image[:, mask] = torch.nan
    torch.set_num_threads(2)
    assert torch.equal(
        complete(image, mask, patch=10, tolerance=0.3, seed=5).texture, first.texture
    )
    assert 0 <= float(first.texture.min()) <= float(first.texture.max()) <= 1


def test_sources_may_be_others_and_masked() -> None:
    image, mask = stripes(40, 40, 1), holes("square", (40, 40))
    sources = [spots(30), stripes(36, 30, 1, seed=4)]
    usable = torch.zeros(36, 30, dtype=torch.bool)
    usable[4:30, 3:28] = True
    done = complete(
        image, mask, source=sources, source_masks=[None, usable], patch=8, poisson=False
    )
    assert torch.equal(done.apply([image, *sources]), done.texture)
    which, row, col = done.source_map.unbind(-1)
    new = done.patches > 0
    assert bool((which[new] > 0).all())
    assert not which[~new].any()
    second = which == 2
    assert bool(usable[row[second], col[second]].all())
    alone = complete(image, mask, source=sources[1], source_masks=usable, patch=8, poisson=False)
    assert torch.equal(alone.apply([image, sources[1]]), alone.texture)


def test_a_picture_can_be_made_of_nothing_but_a_source() -> None:
    everywhere = torch.ones(30, 34, dtype=torch.bool)
    made = complete(noise(3, 30, 34), everywhere, source=stripes(), patch=12, poisson=False)
    assert bool((made.patches > 0).all())
    assert torch.equal(made.apply([noise(3, 30, 34), stripes()]), made.texture)
    other = complete(noise(3, 30, 34), everywhere, source=stripes(), patch=12, seed=1)
    assert not torch.equal(made.texture, other.texture)


def test_a_hole_is_not_filled_with_what_was_there() -> None:
    image, mask = noise(3, 40, 40), holes("square", (40, 40))
    same = complete(image, mask, source=image, patch=12, poisson=False)
    assert torch.equal(same.texture, image)
    other = complete(image, mask, source=image, patch=12, poisson=False, apart=6)
    new = other.patches > 0
    moved = (other.source_map[..., 1:] - new.nonzero().new_tensor(0)) - torch.stack(
        torch.meshgrid(torch.arange(40), torch.arange(40), indexing="ij"), -1
    )
    assert bool((moved[new].abs().amax(-1) >= 6).all())


def test_positions_of_what_was_there_are_carried_on() -> None:
    source, mask = noise(3, 24, 24), holes("square", (40, 40))
    places = torch.randint(0, 24, (40, 40, 3), generator=torch.Generator().manual_seed(0)).float()
    places[..., 0] = 0
    image = source[:, places[..., 1].long(), places[..., 2].long()]
    done = complete(image, mask, source=source, patch=9, positions=places, poisson=False)
    assert torch.equal(done.apply(source), done.texture)


def test_steps_are_told_and_may_cancel() -> None:
    told: list[Stage] = []
    image, mask = stripes(44, 48), holes("square")
    complete(image, mask, patch=8, on_step=told.append)
    assert [stage.done for stage in told] == sorted(stage.done for stage in told)
    assert told[-1].done == 1
    assert told[0].texture.shape == image.shape

    def cancel(_: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        complete(image, mask, patch=8, on_step=cancel)


@pytest.mark.usefixtures("unchecked")
def test_bad_input_is_refused() -> None:
    image, mask = stripes(44, 48), holes("square")
    full = torch.ones_like(mask)
    for given, options, words in (
        (full, {}, "True everywhere and there is no source"),
        (~full, {}, "True nowhere"),
        (mask[1:], {}, "mask is"),
        (mask, {"patch": 2}, "patch=2"),
        (mask, {"patch": 40}, "patch=40 fits nowhere"),
        (mask, {"patch": 33, "source": stripes()}, "patch=33 is larger than a source of 32"),
        (mask, {"order": "random"}, "order='random'"),
        (mask, {"search": "fast", "patch": 8}, "search='fast'"),
        (mask, {"rim": -1}, "rim=-1"),
        (mask, {"apart": -1}, "apart=-1"),
        (mask, {"fresh": -0.5}, "fresh=-0.5"),
        (mask, {"detail": -1.0}, "detail=-1"),
        (mask, {"tolerance": -0.1}, "tolerance=-0.1"),
        (mask, {"seed": -1}, "seed=-1"),
        (mask, {"source": stripes(channels=1)}, "source has 1 channels"),
    ):
        with pytest.raises(ValueError, match=words):
            complete(image, given, **options)
