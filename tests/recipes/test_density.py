"""Density: counts, sources, places, and what is refused."""

import math

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex.layers.elements import Elements
from torchtex.recipes.density import density
from torchtex.recipes.montage import Stage

SPOTS = ((9, 10, 4), (10, 30, 5), (28, 14, 5), (36, 38, 4))


def meadow(size: tuple[int, int] = (48, 52)) -> tuple[Tensor, Elements]:
    """Yellow disks, each with a dark mark in one corner, on green grain; and which is which."""
    row, col = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    labels = torch.zeros(size, dtype=torch.long)
    ground = torch.tensor([0.2, 0.5, 0.15], dtype=torch.float64)[:, None, None]
    image = ground + 0.1 * (noise(3, *size) - 0.5)
    for number, (r, c, radius) in enumerate(SPOTS, 1):
        inside = (row - r) ** 2 + (col - c) ** 2 <= radius**2
        labels[inside] = number
        yellow = torch.tensor([0.9, 0.8, 0.1 * number], dtype=torch.float64)[:, None, None]
        image = torch.where(inside, yellow, image)
        image[:, r - 2, c - 1] = 0.05
    return image, Elements(labels)


def yellow(image: Tensor) -> Tensor:
    return (image[0] > 0.6) & (image[2] < 0.6)


# ------------------------------------------------------------------------------ fewer


def test_all_elements_can_go() -> None:
    image, elements = meadow()
    done = density(image, 0.0, elements=elements)
    assert not bool(yellow(done.texture).any())
    assert done.settings["removed"] == 4
    assert done.settings["after"] == 0
    far = torch.ones(48, 52, dtype=torch.bool)
    for number in range(1, 5):
        rows, cols = elements.box(number)
        far[max(0, rows.start - 7) : rows.stop + 7, max(0, cols.start - 7) : cols.stop + 7] = False
    assert torch.equal(done.texture[:, far], image[:, far])


def test_every_other_one_goes_and_seeds_choose_which() -> None:
    image, elements = meadow()
    kept = set()
    for seed in range(6):
        done = density(image, 0.5, elements=elements, seed=seed)
        assert done.settings["after"] == 2
        there = frozenset(
            n
            for n in range(1, 5)
            if bool(yellow(done.texture)[elements.mask(n)].double().mean() > 0.5)
        )
        assert len(there) == 2
        kept.add(there)
    assert len(kept) > 1
    one = density(image, 0.5, elements=elements, seed=2)
    assert torch.equal(one.texture, density(image, 0.5, elements=elements, seed=2).texture)


def test_a_given_ground_shows_where_elements_were() -> None:
    image, elements = meadow()
    ground = 0.1 * noise(3, 40, 40, seed=9)
    done = density(image, 0.0, elements=elements, ground=ground, poisson=False)
    assert float(done.texture[:, elements.labels > 0].max()) <= 0.1
    assert torch.equal(done.apply([image, ground]), done.texture)


# ------------------------------------------------------------------------------ more


def test_new_elements_are_copies_that_touch_nothing() -> None:
    image, elements = meadow()
    done = density(image, 2.0, elements=elements, poisson=False, seed=4)
    assert done.settings["added"] == 4
    assert torch.equal(done.apply(image), done.texture)
    old = elements.labels > 0
    assert torch.equal(done.texture[:, old], image[:, old])
    fresh = yellow(done.texture) & ~old
    sources = done.source_map[fresh]
    assert bool((elements.labels[sources[:, 1], sources[:, 2]] > 0).all())
    from scipy.ndimage import label

    whole = (yellow(done.texture) | (done.texture.amax(0) < 0.1)).numpy()
    assert label(whole)[1] == 8
    areas = torch.bincount(torch.from_numpy(label(whole)[0]).flatten())[1:]
    wanted = elements.areas.tolist()
    assert all(any(abs(a - b) <= 2 for b in wanted) for a in areas.tolist())


def test_turned_copies_are_exact_and_without_turns_they_stand_upright() -> None:
    image, elements = meadow()
    upright = density(image, 2.0, elements=elements, poisson=False, turn=False, seed=4)
    source = upright.source_map[..., 1:].double()
    new = (upright.patches > 0) & yellow(upright.texture)
    both = new[:, 1:] & new[:, :-1] & (upright.patches[:, 1:] == upright.patches[:, :-1])
    steps = (source[:, 1:] - source[:, :-1])[both]
    assert bool((steps == torch.tensor([0.0, 1.0], dtype=torch.float64)).all())
    turned = density(image, 2.0, elements=elements, poisson=False, seed=4)
    assert not turned.field.positions.is_floating_point()
    assert torch.equal(turned.apply(image), turned.texture)


def test_a_map_says_where() -> None:
    image, elements = meadow((48, 96))
    amount = torch.zeros(48, 96)
    amount[:, 48:] = 2.0  # where there are none yet
    done = density(image, amount, elements=elements, seed=1)
    assert done.settings["removed"] == 4
    assert done.settings["added"] == 2  # 4 elements in the whole, half of it, one more each
    assert not bool(yellow(done.texture)[:, :44].any())
    assert bool(yellow(done.texture)[:, 48:].any())


def test_a_new_picture_of_another_size() -> None:
    image, elements = meadow()
    done = density(image, 1.0, elements=elements, size=(96, 104), poisson=False, seed=2)
    assert done.texture.shape == (3, 96, 104)
    assert done.settings["added"] == 16
    assert torch.equal(done.apply(image), done.texture)
    ground = 0.1 * noise(3, 40, 40, seed=9)
    done = density(image, 0.5, elements=elements, size=(60, 60), ground=ground, poisson=False)
    assert torch.equal(done.apply([image, ground]), done.texture)
    assert float(done.texture[:, ~yellow(done.texture)].mean()) < 0.2
    letter = torch.zeros(96, 104)
    letter[:, 52:] = 1.0
    done = density(image, letter, elements=elements, size=(96, 104))
    assert done.settings["added"] == 8
    assert not bool(yellow(done.texture)[:, :44].any())


def test_the_new_ground_has_the_colours_of_the_old_one_everywhere() -> None:
    image, elements = meadow()
    image = (image + 0.2 * torch.linspace(0, 1, 52, dtype=torch.float64)).clamp(0, 1)  # uneven
    done = density(image, 0.0, elements=elements, size=(96, 104))
    old = image[:, elements.labels == 0]
    for part in done.texture.unfold(1, 32, 32).unfold(2, 26, 26).flatten(1, 2).unbind(1):
        low, high = old.quantile(0.02, 1), old.quantile(0.98, 1)
        middle = part.flatten(1).mean(1)
        assert bool(((middle > low) & (middle < high)).all())


def test_nothing_is_changed_by_one() -> None:
    image, elements = meadow()
    done = density(image, 1.0, elements=elements)
    assert torch.equal(done.texture, image)
    assert done.settings["after"] == 4


def test_elements_are_found_unless_given() -> None:
    pytest.importorskip("skimage")
    pytest.importorskip("sklearn")
    image, _ = meadow()
    assert density(image, 2.0, seed=1).settings["before"] == 4


def test_steps_are_told_and_can_cancel() -> None:
    image, elements = meadow()
    amount = torch.zeros(48, 52)
    amount[24:] = 2.0
    stages: list[Stage] = []
    density(image, amount, elements=elements, on_step=stages.append)
    shares = [stage.done for stage in stages]
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1)
    assert {stage.note for stage in stages} == {"elements removed", "elements added"}

    def stop(stage: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        density(image, 0.0, elements=elements, on_step=stop)


# ------------------------------------------------------------------------------ refused


def test_more_than_fits_says_how_many_fit() -> None:
    image, elements = meadow()
    with pytest.raises(ValueError, match=r"amount: (\d+) of 36 new elements fit, \d+ in all") as e:
        density(image, 10.0, elements=elements)
    assert 2 < int(str(e.value).split()[1]) < 36


@pytest.mark.usefixtures("unchecked")
def test_bad_input_is_one_sentence() -> None:
    image, elements = meadow()
    full = Elements(torch.ones(48, 52, dtype=torch.long))
    cut = Elements(torch.nn.functional.pad(torch.ones(8, 8, dtype=torch.long), (0, 44, 0, 40)))
    for words, given in (
        ("amount=-1 must lie in", {"amount": -1.0}),
        (r"amount=nan", {"amount": math.nan}),
        (r"amount is a map of \(4, 4\)", {"amount": torch.ones(4, 4)}),
        (r"gap=-1", {"amount": 2.0, "gap": -1}),
        (r"seed=-1", {"amount": 2.0, "seed": -1}),
        (r"cover 100 % .* for more; ask for at most 1", {"amount": 2.0, "elements": full}),
        (r"all are cut off", {"amount": 2.0, "elements": cut}),
        (r"cover 100 % of the picture", {"amount": 0.0, "elements": full}),
        (r"elements are of a picture", {"amount": 0.0, "elements": Elements(full.labels[:5])}),
        (r"ground", {"amount": 0.0, "ground": torch.rand(1, 9, 9)}),
    ):
        with pytest.raises(ValueError, match=words):
            density(image, **({"elements": elements} | given))  # type: ignore[arg-type]


# ------------------------------------------------------------------------------ heaps


def heap(contrast: float) -> tuple[Tensor, Elements]:
    """Light tiles in rows, and what looks much like them between, or is plain."""
    row, col = torch.meshgrid(torch.arange(84), torch.arange(80), indexing="ij")
    light = (row % 28 < 9) & (col % 8 < 7)
    between = 0.2 + contrast * ((row // 2 + col // 2) % 2).double()
    image = torch.where(light, 0.9, between)[None] + 0.01 * noise(1, 84, 80)
    number = (row // 28) * 10 + col // 8 + 1
    return image.expand(3, -1, -1).contiguous(), Elements(torch.where(light, number, 0))


@pytest.mark.parametrize("amount", [0.5, 1.5])
def test_a_heap_has_no_ground_and_the_sentence_says_what_helps(amount: float) -> None:
    image, elements = heap(0.3)
    words = "lie close together, .*; .*give a picture of the ground.*; if other .* by at, mask or"
    with pytest.raises(ValueError, match=words):
        density(image, amount, elements=elements)
    fewer = density(image, 0.5, elements=elements, ground=0.2 + 0.05 * noise(3, 40, 40))
    assert fewer.settings["after"] == round(elements.count / 2)
    assert density(image, 1.0, elements=elements).settings["after"] == elements.count


def test_narrow_but_plain_ground_does() -> None:
    image, elements = heap(0.0)
    assert density(image, 0.5, elements=elements).settings["removed"] > 0


def test_elements_that_others_may_hide_are_not_copied() -> None:
    image, elements = meadow()
    labels = elements.labels.clone()
    labels[8:11, 15:20] = 5  # in front of the first
    labels[9:11, 14] = 5
    done = density(image, 1.6, elements=Elements(labels), turn=False, poisson=False)
    new = done.patches > 0
    rows, cols = done.field.positions[0][new][:, 1:].long().unbind(1)
    copied = labels[rows, cols]
    assert done.settings["added"] == 3
    assert not bool(((copied == 1) | (copied == 5)).any())
