"""Given fields, sums of flows, and what is refused as a flow field."""

import doctest
import math

import pytest
import torch
from conftest import noise

from torchtex.flow import fields
from torchtex.flow.fields import Given, Scaled, Summed, Uniform, check_fields, from_center, traced


def test_given_fields_come_in_order_and_keep_their_dtype() -> None:
    fields = noise(3, 2, 5, 4, dtype=torch.float32)
    assert torch.equal(Given(fields)(2, 5, 4), fields[2])
    assert Given(fields)(0, 5, 4).dtype == torch.float32
    assert torch.equal(Given(fields, loop=True)(7, 5, 4), fields[1])
    assert torch.equal(Given(fields[0])(99, 5, 4), fields[0])


def test_given_fields_say_what_does_not_fit() -> None:
    flow = Given(noise(3, 2, 5, 4))
    with pytest.raises(ValueError, match="frame=3: there are 3 flow fields, enough for 4 frames"):
        flow(3, 5, 4)
    with pytest.raises(ValueError, match="5 x 4 pixels do not fit a texture of 6 x 4"):
        flow(0, 6, 4)
    with pytest.raises(ValueError, match="frame=-1 must be at least 0"):
        flow(-1, 5, 4)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        (torch.zeros(3, 4, 5), r"shape \(3, 4, 5\) must be"),
        (torch.zeros(4, 5), r"shape \(4, 5\) must be"),
        (torch.zeros(1, 1, 2, 4, 5), "must be"),
        (torch.zeros(0, 2, 4, 5), "has no frames"),
        (torch.zeros(2, 0, 5), "has no frames or no pixels"),
        (torch.zeros(2, 4, 5, dtype=torch.long), "must be floating point"),
        (torch.tensor(math.nan).expand(2, 4, 5), "NaN or infinity at 20 pixels"),
        (torch.full((2, 4, 5), 4.5), r"moves by 4\.5, more than the height of 4"),
        (torch.stack([torch.zeros(4, 5), torch.full((4, 5), -6.0)]), "more than the width of 5"),
    ],
)
def test_what_is_no_flow_field_is_refused_in_a_sentence(fields: torch.Tensor, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        check_fields(fields)


def test_a_given_flow_is_checked_when_it_is_made() -> None:
    with pytest.raises(ValueError, match="NaN or infinity"):
        Given(torch.full((2, 4, 5), math.nan))


def test_sums_and_multiples() -> None:
    flow = Summed((Uniform((1.0, 2.0)), Scaled(Uniform((1.0, 1.0)), -2.0)))
    assert flow(0, 3, 3)[:, 1, 1].tolist() == [-1.0, 0.0]
    with pytest.raises(ValueError, match="is empty"):
        Summed(())
    with pytest.raises(ValueError, match="factor=inf must be finite"):
        Scaled(flow, math.inf)


def test_tracing_a_rotation_stays_on_circles() -> None:
    place = from_center((0.5, 0.5), 9, 9)
    spin = 0.3
    moved = place + traced(lambda p: spin * torch.stack([-p[1], p[0]]), place)
    torch.testing.assert_close(moved.square().sum(0), place.square().sum(0), rtol=1e-6, atol=1e-9)
    turned = torch.stack(
        [
            place[0] * math.cos(spin) - place[1] * math.sin(spin),
            place[1] * math.cos(spin) + place[0] * math.sin(spin),
        ]
    )
    torch.testing.assert_close(moved, turned, rtol=1e-5, atol=1e-5)


def test_examples() -> None:
    assert doctest.testmod(fields, extraglobs={"torch": torch}).failed == 0
