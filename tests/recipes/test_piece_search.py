"""What a new piece shows: the part that fits, and is not shown already."""

import torch
from conftest import noise, spots

from torchtex.recipes.piece_search import best_part, excess_of, use_of
from torchtex.recipes.pieces import pieces_of, stock_of
from torchtex.sources import pixel_places


def test_the_use_of_a_part_is_counted() -> None:
    places = torch.cat([torch.zeros(32, 32, 1).long(), pixel_places((32, 32)) % 16], 2)
    stock = stock_of([spots(48, 48)], None, (32, 32), steps=1)
    (used,) = use_of(pieces_of(places, 32, torch.Generator().manual_seed(0)), stock)
    assert used[:16, :16].min() == used.max() == 9
    assert used[16:].max() == used[:, 16:].max() == 0


def test_parts_shown_more_often_than_usual_are_in_excess() -> None:
    usual = torch.ones(40, 40, dtype=torch.float64)
    used = usual.clone()
    used[:, :20], used[:, 20:] = 3.0, 0.0
    (excess,) = excess_of([used], [usual])
    assert torch.allclose(excess[:, :14], torch.ones(40, 14, dtype=torch.float64))
    assert torch.allclose(excess[:, 26:], -torch.ones(40, 14, dtype=torch.float64))
    assert excess_of([used], [used])[0].abs().max() == 0


def test_the_part_that_fits_is_found_in_the_right_exemplar() -> None:
    zs = [noise(1, 40, 40), noise(1, 36, 44, seed=1)]
    stock = stock_of(zs, None, (40, 40), side=8)
    none = [torch.zeros(z.shape[1:], dtype=torch.float64) for z in zs]
    found = best_part(stock, zs[1][:, 7:19, 11:23], torch.ones(12, 12), none, 1.0)
    assert found == (1, 7, 11)


def test_parts_that_are_shown_already_are_kept_away_from() -> None:
    z = noise(1, 20, 40)
    z = torch.cat([z, z + 0.001], 1).clamp(0, 1)
    stock = stock_of([z], None, (40, 40), side=8)
    used = torch.zeros(40, 40, dtype=torch.float64)
    used[:20] = 2.0
    wished, weight = z[:, 4:16, 5:17], torch.ones(12, 12, dtype=torch.float64)
    assert best_part(stock, wished, weight, [used], 0.0) == (0, 4, 5)
    assert best_part(stock, wished, weight, [used], 1.0) == (0, 24, 5)


def test_without_room_there_is_none() -> None:
    stock = stock_of([noise(1, 40, 40)], None, (40, 40), side=8)
    bare = type(stock)(stock.size, False, 8, 2, stock.shifted, stock.usable, (None,), stock.steps)
    assert best_part(bare, noise(1, 12, 12), torch.ones(12, 12), [torch.ones(40, 40)], 1.0) is None
