"""Deformations: exact where they copy, kornia's warp elsewhere, the valid region as a mask."""

import math

import pytest
import torch
from conftest import noise, stripes
from kornia.geometry.transform import warp_affine

from torchtex.layers.deform import Deformation, Spread, deform


@pytest.mark.parametrize("channels", [1, 3, 7])
@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("mirror", [False, True])
def test_quarter_turns_and_mirrors_copy_pixels(channels: int, turns: int, mirror: bool) -> None:
    z = noise(channels, 12, 12)
    made = deform(z, Deformation(rotate=90.0 * turns, mirror=mirror))
    wanted = (z.flip(2) if mirror else z).rot90(turns, (1, 2))
    assert torch.equal(made.texture, wanted)
    assert torch.equal(made.field.apply(z), made.texture)
    assert bool(made.mask.all())


def test_moved_by_whole_pixels_the_rest_is_not_valid() -> None:
    z = noise(3, 10, 14)
    made = deform(z, Deformation((2.0, -3.0)))
    assert torch.equal(made.texture[:, 2:, :-3], z[:, :-2, 3:])
    assert int(made.mask.sum()) == 8 * 11
    assert bool(made.mask[2:, :-3].all())
    flipped = deform(z, Deformation(flip=True))
    assert torch.equal(flipped.texture, z.flip(1))


@pytest.mark.parametrize(
    "given",
    [
        Deformation(rotate=31.0),
        Deformation(scale=1.4, translate=(2.3, -1.2)),
        Deformation((1.5, 4.0), -77.0, 0.8, mirror=True),
        Deformation((0.0, 2.0), 12.0, 1.1, flip=True),
    ],
)
def test_inside_it_is_the_warp_of_kornia(given: Deformation) -> None:
    z = stripes(20, 26)
    made = deform(z, given)
    matrix = given.matrix((9.5, 12.5))[[1, 0]][:, [1, 0, 2]][None]
    wanted = warp_affine(z[None], matrix, (20, 26), align_corners=True)[0]
    assert int(made.mask.sum()) > 60
    assert torch.allclose(made.texture[:, made.mask], wanted[:, made.mask], atol=1e-5)
    shown = warp_affine(torch.ones_like(z)[None], matrix, (20, 26), align_corners=True)[0, 0]
    assert bool((shown[made.mask] > 0.999).all())


def test_counter_clockwise_is_what_one_sees() -> None:
    z = torch.zeros(1, 21, 21, dtype=torch.float64)
    z[0, 10, 18] = 1  # to the right of the middle
    made = deform(z, Deformation(rotate=45.0)).texture[0]
    row, col = divmod(int(made.argmax()), 21)
    reach = 8 / math.sqrt(2)
    assert row == round(10 - reach)
    assert col == round(10 + reach)


def test_several_are_applied_in_order_about_a_pivot() -> None:
    z = noise(1, 16, 16)
    steps = [Deformation(rotate=90.0), Deformation((3.0, 0.0))]
    made = deform(z, steps)
    assert torch.equal(made.texture[:, 3:], z.rot90(1, (1, 2))[:, :-3])
    about = deform(z, Deformation(rotate=180.0), pivot=(4.0, 4.0))
    assert torch.equal(about.texture[:, :9, :9], z[:, :9, :9].flip((1, 2)))
    assert not bool(about.mask[9:].any())


def test_masks_are_deformed_and_hold_whole_pixels_alone() -> None:
    z, mask = noise(3, 16, 16), torch.zeros(16, 16, dtype=torch.bool)
    mask[4:9, 3:8] = True
    made = deform(z, Deformation(rotate=90.0), mask=mask)
    assert torch.equal(made.mask, mask.rot90(1, (0, 1)))
    z[:, ~mask] = 100.0  # what the mask leaves out is nowhere seen
    turned = deform(z, Deformation(rotate=30.0), mask=mask)
    assert bool(turned.mask.any())
    assert float(turned.texture[:, turned.mask].max()) < 1.1


def test_shrunk_pictures_are_averaged() -> None:
    checks = (torch.arange(64)[:, None] + torch.arange(64)) % 2
    made = deform(checks[None].double(), Deformation(scale=0.25), size=(64, 64))
    assert 200 < int(made.mask.sum()) <= 256
    assert float((made.texture[0, made.mask] - 0.5).abs().max()) < 0.2
    assert torch.allclose(made.field.apply(checks[None].double()), made.texture)


def test_draws_stay_in_their_ranges_and_repeat() -> None:
    spread = Spread((-4.0, 4.0), (0.0, 2.0), (-30.0, 60.0), (0.8, 1.25), 0.5, 0.25)
    drawn = [spread.draw(torch.Generator().manual_seed(seed)) for seed in range(60)]
    assert drawn == [spread.draw(torch.Generator().manual_seed(seed)) for seed in range(60)]
    assert len(set(drawn)) == 60
    for one in drawn:
        assert -4 <= one.translate[0] <= 4
        assert 0 <= one.translate[1] <= 2
        assert -30 <= one.rotate <= 60
        assert 0.8 <= one.scale <= 1.25
    assert 15 < sum(one.mirror for one in drawn) < 45
    assert 3 < sum(one.flip for one in drawn) < 30


def test_bad_input_is_refused() -> None:
    for scale in (0.05, 11.0, math.nan):
        with pytest.raises(ValueError, match="scale="):
            Deformation(scale=scale)
    with pytest.raises(ValueError, match="translate="):
        Deformation((math.inf, 0.0))
    with pytest.raises(ValueError, match=r"scale=0.5:20"):
        Spread(scale=(0.5, 20.0))
    with pytest.raises(ValueError, match=r"rotate=5.0:-5"):
        Spread(rotate=(5.0, -5.0))
    with pytest.raises(ValueError, match="mirror=2"):
        Spread(mirror=2.0)
    with pytest.raises(ValueError, match=r"8x8 vanished: .* after translate=\(9.0, 0.0\);"):
        deform(noise(1, 8, 8), Deformation((9.0, 0.0)))
    with pytest.raises(ValueError, match="mask is 3x3"):
        deform(noise(1, 8, 8), Deformation(), mask=torch.ones(3, 3, dtype=torch.bool))
