"""Parts of filling: boxes of holes, offsets that are offered, cuts among them."""

import pytest
import torch
from conftest import noise, stripes

from torchtex.cuts.mincut import default_solver
from torchtex.recipes.hole_boxes import around, boxes_of
from torchtex.recipes.hole_cut import Hole
from torchtex.recipes.offsets import fitting, frequent, rim_offsets
from torchtex.sources import pixel_places


def square() -> torch.Tensor:
    target = torch.zeros(40, 44, dtype=torch.bool)
    target[14:24, 16:28] = True
    return target


def test_boxes_hold_every_hole_once() -> None:
    mask = noise(60, 70, seed=2) > 0.999
    mask[5:9, 50:60] = True
    covered = torch.zeros_like(mask, dtype=torch.long)
    for box in boxes_of(mask, 8):
        covered[box] += 1
    assert int(covered.max()) == 1
    assert bool((covered[mask] == 1).all())


def test_all_of_a_photo_is_searched_where_what_is_near_holds_no_window() -> None:
    known = torch.zeros(40, 80, dtype=torch.bool)
    known[:, 60:] = True
    wide = around((slice(10, 14), slice(8, 12)), 2, 6, known, 8)[1]
    assert wide == (slice(0, 40), slice(0, 80))


@pytest.mark.parametrize("count", [1, 2, 7, 40])
def test_offsets_of_a_rim_lead_to_what_is_known_and_alike(count: int) -> None:
    row, col = torch.meshgrid(torch.arange(40), torch.arange(44), indexing="ij")
    image = (0.5 + 0.4 * torch.sin(2 * torch.pi * (row + 2 * col) / 8))[None].double()
    target = square()
    found = rim_offsets(image, ~target, target, count)
    assert 1 <= len(found) <= count
    assert not ((found[:, 0] + 2 * found[:, 1]) % 8).any()
    assert bool(found.any(1).all())  # never the hole itself


def test_offsets_of_a_hole_with_nothing_around_it_are_none() -> None:
    known = torch.zeros(20, 20, dtype=torch.bool)
    assert not len(rim_offsets(noise(1, 20, 20), known, ~known, 8))
    assert fitting(known, 8) == 0


def test_frequent_rows_come_first() -> None:
    moved = torch.tensor([[0, 1], [2, 2], [2, 2], [5, 0], [5, 0], [5, 0]])
    assert frequent(moved, 2).tolist() == [[5, 0], [2, 2]]


def test_a_cut_takes_the_offset_that_continues_the_pattern() -> None:
    image, target = stripes(40, 44), square()
    hole = Hole(torch.where(target, 0, image), ~target, target)
    places = pixel_places((40, 44), image.device)
    bad = places.clone()
    bad[target] = places[target] + torch.tensor([-14, 3])
    offered = rim_offsets(hole.image, hole.known, target, 24)
    found = hole.cut(bad, offered, 10.0, 0.0, default_solver(), None)
    assert torch.equal(found[~target], places[~target])
    before, after = ((hole.pixels(p) - image).abs()[:, target].mean() for p in (bad, found))
    assert float(after) < 0.2 * float(before)


def test_poisson_levels_light_and_keeps_edges_between_colours() -> None:
    target = torch.zeros(24, 48, dtype=torch.bool)
    target[4:20, 8:40] = True
    places = pixel_places((24, 48), target.device)
    places[target] = torch.tensor([2, 2])
    places[:, 24:][target[:, 24:]] = torch.tensor([2, 45])
    gaps = []
    for step in (0.05, 0.8):
        image = torch.full((3, 24, 48), 0.1, dtype=torch.float64)
        image[:, :, 24:] += step
        filled = Hole(image, ~target, target).pixels(places, poisson=True)
        gaps.append(float((filled[0, 12, 24] - filled[0, 12, 23]) / step))
    assert gaps[0] < 0.5 < gaps[1]
