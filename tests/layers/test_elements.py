"""Elements found by their colours, in masks, and by a point."""

import pytest
import torch
from conftest import noise
from torch import Tensor

pytest.importorskip("skimage")
pytest.importorskip("sklearn")

from torchtex.layers.elements import Elements, bounded, find_elements

SPOTS = ((12, 14, 5), (14, 40, 6), (34, 20, 7), (44, 46, 6), (30, 58, 5))


def meadow(dots: tuple[tuple[int, int, int], ...] = SPOTS, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Yellow disks on green, and where they are."""
    row, col = torch.meshgrid(torch.arange(56), torch.arange(64), indexing="ij")
    where = torch.zeros(56, 64, dtype=torch.bool)
    for r, c, radius in dots:
        where |= (row - r) ** 2 + (col - c) ** 2 <= radius**2
    green = torch.tensor([0.2, 0.5, 0.15], dtype=torch.float64)[:, None, None]
    yellow = torch.tensor([0.9, 0.8, 0.2], dtype=torch.float64)[:, None, None]
    image = torch.where(where, yellow, green) + 0.12 * (noise(3, 56, 64, seed=seed) - 0.5)
    return image.clamp(0, 1), where


def test_disks_on_a_meadow_are_found_one_by_one() -> None:
    image, where = meadow()
    found = find_elements(image)
    assert found.count == len(SPOTS)
    assert float(((found.labels > 0) == where).double().mean()) > 0.95
    middles = torch.tensor([spot[:2] for spot in SPOTS]).double()
    apart = torch.cdist(found.centers(), middles)
    assert float(apart.amin(1).max()) < 1
    assert found.cover == pytest.approx(float(where.double().mean()), abs=0.04)
    assert found.picture(image).shape == (3, 56, 64)


def test_same_seed_same_elements_and_other_colours_too() -> None:
    image, where = meadow()
    assert torch.equal(find_elements(image, seed=3).labels, find_elements(image, seed=3).labels)
    dark = find_elements(1 - image)
    assert float(((dark.labels > 0) == where).double().mean()) > 0.95
    grey = find_elements(image.mean(0, keepdim=True))
    assert grey.count == len(SPOTS)


def test_touching_disks_are_cut_apart_at_their_waist() -> None:
    image, where = meadow(((20, 20, 9), (20, 36, 9), (42, 50, 8)))
    for found in (find_elements(image), find_elements(image, where)):
        assert found.count == 3
        assert found.labels[20, 20] != found.labels[20, 36]
        areas = found.areas.double()
        assert float(areas.max() / areas.min()) < 1.5


def test_those_that_the_edge_cuts_off_are_not_whole() -> None:
    image, _ = meadow(((20, 20, 7), (0, 40, 7), (45, 63, 6), (40, 40, 7)))
    found = find_elements(image)
    assert found.count == 4
    numbers = {int(found.labels[20, 20]), int(found.labels[40, 40])}
    assert set(found.whole().tolist()) == numbers
    box = found.box(int(found.labels[20, 20]))
    assert abs(box[0].start - 13) <= 1
    assert abs(box[1].stop - 28) <= 1


def test_a_point_tells_which_colour_is_meant() -> None:
    image, _ = meadow()
    blue = torch.tensor([0.2, 0.2, 0.9], dtype=torch.float64)[:, None, None]
    image[:, 2:8, 50:58] = blue
    image[:, 48:54, 4:12] = blue
    found = find_elements(image, at=(5, 54))
    assert found.labels[5, 54] > 0
    assert found.labels[50, 8] > 0


@pytest.mark.usefixtures("unchecked")
def test_bad_input_is_one_sentence() -> None:
    image, where = meadow()
    for words, given in (
        ("mask has 0 pixels", {"mask": torch.zeros_like(where)}),
        ("mask of 56 x 64", {"mask": where[:20]}),
        ("colors=7", {"colors": 7}),
        ("least=0", {"least": 0}),
        ("least=5000 pixels or more", {"mask": where, "least": 5000}),
        ("no elements of least=5000", {"least": 5000}),
        (r"at=\(99, 0\)", {"at": (99, 0)}),
    ):
        with pytest.raises(ValueError, match=words):
            find_elements(image, **given)  # type: ignore[arg-type]


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "sklearn", None)
    with pytest.raises(ImportError, match=r"torchtex\[design\]"):
        find_elements(meadow()[0])


def test_labels_count_from_one() -> None:
    found = Elements(torch.tensor([[0, 2, 2], [1, 0, 0]]))
    assert found.areas.tolist() == [1, 2]
    assert found.centers().tolist() == [[1.0, 0.0], [0.0, 1.5]]


def test_the_few_dark_spots_are_the_elements_and_not_the_large_light_rest() -> None:
    image, _ = meadow(((10, 12, 6), (12, 26, 6), (24, 18, 6), (40, 44, 7), (30, 54, 6)))
    light = (1 - image).mean(0, keepdim=True).expand(3, -1, -1)
    found = find_elements(light)
    assert found.labels[40, 44] > 0
    assert found.labels[50, 10] == 0
    assert found.cover < 0.3


def test_typical_size_is_that_of_what_covers_most() -> None:
    labels = torch.zeros(20, 40, dtype=torch.long)
    labels[2:12, 2:12] = 1
    labels[2:12, 20:30] = 2
    assert Elements(labels).typical == pytest.approx(10.0)
    labels[16, 35] = 3
    assert Elements(labels).typical > 9.8
    assert Elements(torch.zeros(4, 4, dtype=torch.long)).typical == 0.0


def test_borders_to_the_ground_to_others_and_to_the_edge() -> None:
    labels = torch.zeros(8, 12, dtype=torch.long)
    labels[2:4, 2:4], labels[2:4, 4:6], labels[6:, 9:11] = 1, 2, 3
    assert bounded(labels.numpy()).tolist() == pytest.approx([0.75, 0.75, 0.75])
