"""Pictures of flows: sizes, directions of streaks and arrows, and the same bits each time."""

import doctest
from typing import Literal

import pytest
import torch
from conftest import noise, stripes

from torchtex.flow import pictures
from torchtex.flow.fields import Flow, Uniform, from_center
from torchtex.flow.formulas import Rotation, Saddle
from torchtex.flow.pictures import direction_colors, draw_arrows, flow_picture, lic
from torchtex.flow.vortices import Vortices, vortex_pair
from torchtex.quadratic import threads

KINDS: tuple[Literal["lic", "arrows", "both"], ...] = ("lic", "arrows", "both")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("color", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_pictures_are_images(
    kind: Literal["lic", "arrows", "both"], color: bool, dtype: torch.dtype
) -> None:
    field = vortex_pair()(0, 20, 24).to(dtype)
    for background in (None, stripes(16, 16).to(dtype), noise(1, 20, 24)):
        picture = flow_picture(field, kind=kind, background=background, color=color, zoom=2)
        assert picture.shape == (3, 40, 48)
        assert picture.dtype == dtype
        assert picture.min() >= 0
        assert picture.max() <= 1
        assert picture.std() > 0.01


def test_streaks_lie_along_the_flow() -> None:
    picture = lic(Uniform((0.0, 2.0))(0, 48, 48), periodic=True)
    along = (picture - picture.roll(1, 1)).square().mean()
    across = (picture - picture.roll(1, 0)).square().mean()
    assert along < 0.1 * across
    assert float(picture.mean()) == pytest.approx(0.5, abs=0.03)
    assert float(picture.std()) == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("flow", [Rotation(8.0), Vortices((4.0,))])
def test_streaks_of_closed_whirls_are_closed(flow: Flow) -> None:
    """Slopes of the picture, which lie across streaks, do not lean to a side of the radius."""
    field = flow(0, 65, 65)
    offset = from_center((0.5, 0.5), 65, 65)
    radius = offset.square().sum(0).sqrt()
    ring = (radius > 6) & (radius < 26)
    picture = lic(field, length=40.0)
    turned = offset / radius.clamp(min=1)
    slope = torch.stack(torch.gradient(picture))
    tensor = (slope[:, None] * slope[None])[:, :, ring]
    out, side = turned[:, ring], torch.stack([-turned[1], turned[0]])[:, ring]
    straight = torch.einsum("in,ijn,jn->", out, tensor, out)
    skew = torch.einsum("in,ijn,jn->", out, tensor, side)
    assert abs(float(skew / straight)) < 0.02


def test_a_flow_at_rest_has_a_picture_too() -> None:
    still = torch.zeros(2, 20, 20)
    for kind in KINDS:
        assert flow_picture(still, kind=kind, color=True).isfinite().all()


@pytest.mark.parametrize("side", [33, 48, 51])
def test_an_arrow_without_length_is_a_dot(side: int) -> None:
    field = Saddle()(0, side, side)
    drawn = draw_arrows(torch.zeros(3, side, side).double(), field, spacing=side // 3)[0]
    middle = drawn[side // 2 - 5 : side // 2 + 6, side // 2 - 5 : side // 2 + 6]
    assert 1 <= int((middle > 0.3).sum()) <= 20


def test_arrow_heads_are_in_front() -> None:
    drawn = draw_arrows(torch.zeros(3, 40, 40).double(), Uniform((0.0, 2.0))(0, 40, 40), spacing=40)
    column = (drawn[0] > 0.5).sum(0)
    assert column[28:36].max() > 2 * column[4:12].max()
    assert drawn[0, 0].max() == 0


def test_colours_show_the_direction() -> None:
    right, left = torch.tensor([0.0, 1.0]), torch.tensor([0.0, -1.0])
    colors = direction_colors(torch.stack([right, left], 1)[..., None])
    assert colors[0, 0, 0] > colors[2, 0, 0] + 0.3  # red
    assert colors[2, 1, 0] > colors[0, 1, 0] + 0.3  # cyan
    grey = direction_colors(torch.zeros(2, 1, 1))
    assert grey.std() == 0


def test_bits_are_the_same_each_time_and_for_any_thread_count() -> None:
    field = Rotation(2.0)(0, 130, 140)
    one = flow_picture(field, color=True)
    with threads(2):
        two = flow_picture(field, color=True)
    assert torch.equal(one, two)
    other = flow_picture(field, color=True, generator=torch.Generator().manual_seed(5))
    assert not torch.equal(one, other)


def test_wrong_arguments_are_refused_in_a_sentence() -> None:
    field = torch.zeros(2, 8, 8)
    with pytest.raises(ValueError, match="zoom=0 must be at least 1"):
        flow_picture(field, zoom=0)
    with pytest.raises(ValueError, match="spacing=2 must be at least 4"):
        flow_picture(field, spacing=2)
    with pytest.raises(ValueError, match="background has 2 channels"):
        flow_picture(field, background=torch.zeros(2, 8, 8))
    with pytest.raises(ValueError, match=r"length=0\.0 must be at least 1"):
        lic(field, length=0.0)


def test_examples() -> None:
    assert doctest.testmod(pictures, extraglobs={"torch": torch}).failed == 0
