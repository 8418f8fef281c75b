"""How pieces move: as the flow moves their structure."""

import torch
from conftest import spots

from torchtex.recipes.piece_motion import advanced, middles, speeds
from torchtex.recipes.pieces import Pieces, Stock, pieces_of, stock_of
from torchtex.sources import pixel_places


def ready(side: int = 48) -> tuple[Pieces, Stock]:
    """A frame that shows one exemplar as it is, in cells."""
    places = torch.cat([torch.zeros(48, 48, 1).long(), pixel_places((48, 48))], 2)
    stock = stock_of([spots(48, 48)], None, (48, 48), side=16)
    return pieces_of(places, side, torch.Generator().manual_seed(0)), stock


def turning() -> torch.Tensor:
    """A slow turn about the middle."""
    gap = pixel_places((48, 48)).double() - 23.5
    return 0.03 * torch.stack([-gap[..., 1], gap[..., 0]], -1)


def test_without_a_frame_pieces_move_on_average() -> None:
    pieces, _ = ready(16)
    got = speeds(pieces, turning())
    for number in range(len(got)):
        assert torch.allclose(got[number], turning()[pieces.owner == number].mean(0))


def test_a_flow_that_is_the_same_all_over_is_followed() -> None:
    pieces, _ = ready(16)
    flow = torch.tensor([0.25, -0.5]).double().expand(48, 48, 2)
    assert torch.allclose(speeds(pieces, flow, spots(48, 48)), flow[0, :9])


def test_pieces_follow_their_structure() -> None:
    pieces, _ = ready()
    last = torch.full((1, 48, 48), 0.5, dtype=torch.float64)
    last[:, 4:12, 4:12] = spots(8, 8)[:1]
    flow = turning()
    there = flow[4:12, 4:12].mean((0, 1))
    plain, fitted = (speeds(pieces, flow, frame)[0] for frame in (None, last))
    assert (fitted - there).norm() < 0.5 * (plain - there).norm()


def test_no_motion_changes_less_to_first_order() -> None:
    pieces, _ = ready()
    last, flow = spots(48, 48), turning() + 0.1
    slopes = torch.stack([slope.double() for slope in torch.gradient(last, dim=(1, 2))], -1)

    def change(speed: torch.Tensor) -> float:
        return float((slopes * (speed - flow)).sum(-1).square().sum())

    best = change(speeds(pieces, flow, last)[0])
    assert best < change(speeds(pieces, flow)[0])


def test_pixels_without_a_piece_count_for_none() -> None:
    pieces, _ = ready()
    owner = pieces.owner.clone()
    owner[:, 24:] = -1
    half = Pieces(owner, owner, pieces.age, pieces.which, pieces.source, pieces.place)
    flow = torch.zeros(48, 48, 2, dtype=torch.float64)
    flow[:, 24:] = 5.0
    for last in (None, spots(48, 48)):
        assert float(speeds(half, flow, last).abs().max()) == 0


def test_threads_do_not_change_a_bit() -> None:
    pieces, _ = ready(16)
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(speeds(pieces, turning(), spots(48, 48)))
    assert torch.equal(*found)


def test_what_moves_on_leaves_bare_pixels_and_new_middles() -> None:
    pieces, stock = ready(16)
    flow = torch.full((48, 48, 2), 2.0, dtype=torch.float64)
    moved, bare = advanced(pieces, stock, flow, speeds(pieces, flow))
    assert bool((moved.owner[bare] == -1).all())
    assert int(bare.sum()) == 2 * 48 + 2 * 46
    inner = (middles(pieces, stock) - 23.5).abs().max(1).values < 12
    gone = middles(moved, stock) - middles(pieces, stock)
    assert torch.allclose(gone[inner], torch.tensor(2.0).double())
