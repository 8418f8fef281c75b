"""Mending: only where pieces meet, by windows nearer to the exemplar, masks and borders kept."""

from pathlib import Path

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex import metrics
from torchtex.recipes import torn_windows
from torchtex.recipes.torn_windows import mended
from torchtex.sources import SourceField, copied, pixel_places


def piece(size: tuple[int, int], at: tuple[int, int, int]) -> Tensor:
    """Sources of a crop: exemplar, row and column of its first pixel."""
    places = pixel_places(size) + torch.tensor(at[1:])
    return torch.cat([torch.full((*size, 1), at[0]), places], 2)


def halves(left: tuple[int, int, int], right: tuple[int, int, int]) -> Tensor:
    """Two crops of 32 x 16 side by side."""
    return torch.cat([piece((32, 16), left), piece((32, 16), right)], 1)


def test_one_piece_is_left_alone() -> None:
    z = noise(3, 40, 40)
    field = copied(piece((24, 28), (0, 5, 3)), ((40, 40),))
    assert mended(field, [z], [None]) is field


def test_only_where_pieces_meet() -> None:
    z = noise(3, 40, 40)
    field = copied(halves((0, 0, 0), (0, 8, 20)), ((40, 40),))
    made, before = mended(field, [z], [None]), field.apply(z)
    after = made.apply(z)
    same = (before == after).all(0).all(0)
    assert same.nonzero()[:, 0].tolist() == [*range(12), *range(20, 32)]
    assert bool((made.weights > 0).sum(0)[:, 12:20].max() > 1)
    assert torch.allclose(made.apply(torch.ones_like(z)), torch.ones_like(after))
    assert torch.allclose(made.apply(0.5 * z + 0.2), 0.5 * after + 0.2)


def test_what_the_exemplar_holds_is_found() -> None:
    z = stripes(40, 40)
    wrong = halves((0, 0, 0), (0, 8, 19))
    field = copied(wrong, ((40, 40),))
    made = mended(field, [z], [None])
    assert metrics.tail(made.apply(z), z) < 0.9 * metrics.tail(field.apply(z), z)


def test_a_seam_that_cannot_be_seen_stays() -> None:
    z = noise(2, 40, 20).repeat(1, 1, 2)  # columns 20 apart are alike
    field = copied(halves((0, 0, 0), (0, 0, 36 - 20)), ((40, 40),))
    far = copied(
        torch.cat([piece((32, 12), (0, 0, 0)), piece((32, 8), (0, 0, 32))], 1), ((40, 40),)
    )
    assert mended(field, [z], [None]) is field
    assert torch.allclose(mended(far, [z], [None]).apply(z), far.apply(z))


def test_seams_across_a_periodic_border() -> None:
    z = noise(3, 40, 40)
    field = copied(piece((32, 32), (0, 4, 4)), ((40, 40),))
    made = mended(field, [z], [None], periodic=True)
    changed = (made.apply(z) != field.apply(z)).any(0)
    assert changed[:4].double().mean() > 0.8
    assert changed[:, -4:].double().mean() > 0.8
    assert not bool(changed[4:-4, 4:-4].any())


def test_masks_and_several_exemplars() -> None:
    zs = [noise(7, 40, 36, seed=n) for n in (1, 2)]
    masks = [torch.zeros(40, 36, dtype=torch.bool) for _ in zs]
    masks[0][:33, :17] = True
    masks[1][7:39, 11:29] = True
    shapes = ((40, 36), (40, 36))
    made = mended(copied(halves((0, 0, 0), (1, 7, 11)), shapes), zs, masks)
    which, row, col = made.positions.unbind(-1)
    assert bool(torch.stack(masks)[which, row, col].all())
    assert len(made.weights) > 1


def test_masks_that_leave_no_even_place() -> None:
    z, mask = noise(1, 40, 40), torch.zeros(40, 40, dtype=torch.bool)
    mask[1:9, 1:9] = True
    field = copied(halves((0, 1, 1), (0, 1, 1)).clamp(max=8), ((40, 40),))
    made = mended(field, [z], [mask])
    row, col = made.positions[..., 1:].unbind(-1)
    assert bool(mask[row, col].all())


@pytest.mark.parametrize(("side", "layers"), [(6, 4), (5, 4), (3, 1)])
def test_small_exemplars_have_small_windows(side: int, layers: int) -> None:
    z = noise(1, side, side)
    field = copied(torch.zeros(24, 24, 3).long(), ((side, side),))
    assert len(mended(field, [z], [None]).weights) == layers


def test_bands_do_not_change_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    z = noise(3, 40, 40).float()
    field = copied(halves((0, 0, 0), (0, 8, 20)), ((40, 40),))
    whole = mended(field, [z], [None])
    monkeypatch.setattr(torn_windows, "_MOST", 16)
    again = mended(field, [z], [None])
    assert torch.equal(whole.positions, again.positions)
    assert torch.allclose(whole.weights, again.weights, atol=1e-6)
    assert whole.apply(z).dtype == torch.float32
    whole.save(tmp_path / "l.npz")
    assert torch.equal(SourceField.load(tmp_path / "l.npz").apply(z), whole.apply(z))
