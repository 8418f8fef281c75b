"""Pieces and their moves: what they show, where they go, what takes their place."""

import pytest
import torch
from conftest import noise, spots

from torchtex.recipes.moving import Canvas, Costs
from torchtex.recipes.pieces import OLD, Pieces, Stock, pieces_of, rendered, stock_of
from torchtex.sources import pixel_places

STILL = torch.zeros(2, 48, 48, dtype=torch.float64)


def ready(*, periodic: bool = False, side: int = 16) -> tuple[Pieces, Stock]:
    """A frame that shows one exemplar as it is, in cells."""
    places = torch.cat([torch.zeros(48, 48, 1).long(), pixel_places((48, 48))], 2)
    stock = stock_of([spots(48, 48)], None, (48, 48), periodic=periodic, side=side)
    return pieces_of(places, side, torch.Generator().manual_seed(0)), stock


def test_cells_show_the_exemplar_itself() -> None:
    pieces, stock = ready()
    assert len(pieces.which) == 9
    texture, field = rendered(pieces, stock, 3)
    assert torch.equal(texture, spots(48, 48))
    assert torch.equal(field.apply(spots(48, 48)), texture)


def test_pieces_move_by_the_mean_flow_over_them() -> None:
    pieces, stock = ready()
    flow = STILL.clone()
    flow[1] = torch.where(torch.arange(48) < 24, 0.25, 0.5)
    canvas = Canvas(pieces, stock, flow)
    canvas.move()
    gone = canvas.pieces.place - pieces.place
    assert gone[:, 0].abs().max() == 0
    assert 0.25 == gone[:, 1].min() < gone[:, 1].max() == 0.5


def test_a_frame_that_slides_shows_the_same_a_pixel_further() -> None:
    pieces, stock = ready()
    canvas = Canvas(pieces, stock, STILL + 1)
    canvas.move()
    assert torch.equal(canvas.bare, canvas.pieces.owner < 0)
    assert int(canvas.bare.sum()) == 48 + 47
    canvas.grow(anywhere=True)
    texture, _ = rendered(canvas.done(3), stock, 3)
    assert torch.equal(texture[:, 1:, 1:], spots(48, 48)[:, :-1, :-1])


def test_tiles_have_no_holes_when_they_slide() -> None:
    pieces, stock = ready(periodic=True)
    canvas = Canvas(pieces, stock, STILL + 3)
    canvas.move()
    assert not canvas.bare.any()
    texture, _ = rendered(canvas.done(3), stock, 3)
    assert torch.equal(texture, spots(48, 48).roll((3, 3), (1, 2)))


def test_holes_are_covered_by_new_pieces() -> None:
    pieces, stock = ready()
    canvas = Canvas(pieces, stock, STILL)
    owner = pieces.owner.clone()
    owner[8:36, 8:36] = -1
    canvas.pieces = Pieces(owner, owner.clone(), pieces.age, *tables(pieces))
    canvas.bare = owner < 0
    canvas.show()
    assert canvas.cover(20) > 0
    assert not (canvas.pieces.owner < 0).any()
    texture, _ = rendered(canvas.done(3), stock, 3)
    assert (texture - spots(48, 48)).square().mean().sqrt() < 0.2


def test_changes_fade_in_over_frames() -> None:
    pieces, stock = ready()
    age = torch.zeros_like(pieces.age)
    other = (pieces.owner + 1) % len(pieces.which)
    shares = []
    for _ in range(4):
        _, field = rendered(Pieces(pieces.owner, other, age, *tables(pieces)), stock, 3)
        shares.append(float(field.weights[0].mean()))
        age = age + 1
    assert shares == [0.25, 0.5, 0.75, 1.0]


def test_pieces_of_few_pixels_are_taken_away() -> None:
    pieces, stock = ready()
    owner = pieces.owner.clone()
    owner[20, 20] = 9
    table = (torch.cat([x, x[:1]]) for x in tables(pieces))
    canvas = Canvas(Pieces(owner, owner, pieces.age, *table), stock, STILL)
    canvas.drop(2)
    assert (canvas.pieces.owner < 0).nonzero().tolist() == [[20, 20]]
    canvas.grow()
    assert canvas.pieces.owner.min() >= 0
    assert canvas.pieces.age[20, 20] == OLD


def test_what_fits_stays() -> None:
    pieces, stock = ready()
    canvas = Canvas(pieces, stock, STILL, Costs())
    canvas.show()
    canvas.mend(1)
    assert canvas.renew(3, 0.1) == 0
    assert torch.equal(rendered(canvas.done(0), stock, 0)[0], spots(48, 48))


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_exemplars_are_read_between_pixels(steps: int) -> None:
    wave = (0.5 + 0.4 * torch.sin(torch.arange(32, dtype=torch.float64) / 3)).expand(1, 32, 32)
    stock = stock_of([wave.contiguous()], None, (32, 32), side=8, steps=steps)
    units = torch.tensor([[40, 41 * steps // 4]])
    at = units[0, 1].item() / steps
    wanted = 0.5 + 0.4 * torch.sin(torch.tensor(at, dtype=torch.float64) / 3)
    assert abs(float(stock.read(torch.tensor([0]), units)[0, 0] - wanted)) < 0.01


def test_masks_are_kept_away_from() -> None:
    mask = torch.ones(40, 40, dtype=torch.bool)
    mask[:, 30:] = False
    stock = stock_of([noise(1, 40, 40)], [mask], (32, 32), side=16)
    assert not stock.usable[0][:, 28:].any()
    assert stock_of([noise(1, 40, 40)], [mask], (32, 32), steps=1).usable[0].sum() == 1200


def tables(pieces: Pieces) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What is known of each piece."""
    return pieces.which, pieces.source, pieces.place


def test_the_more_it_is_held_the_closer_to_the_warped_frame() -> None:
    pieces, stock = ready()
    table = [torch.cat([x, x]) for x in tables(pieces)]
    table[1][9:] += torch.tensor([5.0, 0.0])  # the same pieces, of what is five rows further
    owner = torch.where(pieces.owner == 4, 13, pieces.owner)
    torn = Pieces(owner, owner, pieces.age, *table)
    wished = rendered(torn, stock, 0)[0]
    gaps = []
    for hold in (0.0, 0.3, 5.0):
        canvas = Canvas(torn, stock, STILL, Costs(hold=hold), wished=wished)
        canvas.show()
        canvas.mend(1)
        gaps.append(float((rendered(canvas.done(0), stock, 0)[0] - wished).abs().sum()))
    assert gaps[0] > gaps[1] >= gaps[2]
    assert gaps[0] > 1
    assert gaps[2] < 0.1 * gaps[0]


def test_parts_that_are_shown_too_often_give_way_to_those_that_are_missing() -> None:
    stock = stock_of([torch.full((1, 48, 96), 0.5)], None, (48, 48), side=24)  # no seam costs
    places = torch.cat([torch.zeros(48, 48, 1).long(), pixel_places((48, 48))], 2)
    places[:, 24:, 2] += 24
    pieces = pieces_of(places, 48, torch.Generator().manual_seed(0))
    usual = torch.zeros(48, 96, dtype=torch.float64)
    usual[:, 48:] = 2.0  # of which only the right half of the frame shows anything
    left = (pieces.source[:, 1] - pieces.place[:, 1]) == 0
    shares = []
    for balance in (0.0, 0.1):
        canvas = Canvas(pieces, stock, STILL, Costs(balance=balance), usual=[usual])
        canvas.show()
        canvas.mend(1)
        shares.append(float(left[canvas.pieces.owner].double().mean()))
    assert shares[0] == 0.5
    assert shares[1] < 0.46
