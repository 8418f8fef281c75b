"""Controls: soft constraints, guides, other sizes."""

import doctest
from collections.abc import Callable

import pytest
import torch
from conftest import noise, stripes

from torchtex import controls
from torchtex.controls import Guide, Scaled, SoftConstraint
from torchtex.energy import Bounded, Energy


def pull(seed: int = 0) -> SoftConstraint:
    return SoftConstraint(noise(2, 8, 9, seed=seed), noise(8, 9, seed=seed + 1))


def test_soft_constraint_by_hand_and_by_gradcheck() -> None:
    control, x = pull(), noise(2, 8, 9, seed=5)
    expected = (control.confidence * (x - control.target).square()).sum()
    torch.testing.assert_close(control(x), expected)
    assert torch.autograd.gradcheck(control, (x.requires_grad_(),))


def test_its_bound_is_itself() -> None:
    control = pull()
    q = control.quadratic_bound(noise(2, 8, 9, seed=5))
    assert q is not None
    for seed in range(4):
        y = 3 * noise(2, 8, 9, seed=10 + seed)
        torch.testing.assert_close(q(y), control(y))
    assert isinstance(control, Energy)
    assert isinstance(control, Bounded)
    assert isinstance(control, Scaled)


def test_the_dtype_of_the_image_rules() -> None:
    x = noise(2, 8, 9, dtype=torch.float32)
    assert pull()(x).dtype == torch.float32
    q = pull().quadratic_bound(x)
    assert q is not None
    assert q(x).dtype == torch.float32


def test_at_its_own_size_nothing_changes_where_it_holds() -> None:
    control = SoftConstraint(noise(2, 8, 8), noise(8, 8, seed=1).round())
    same = control.at(8, 8)
    torch.testing.assert_close(same.confidence, control.confidence)
    held = control.confidence > 0
    torch.testing.assert_close(same.target[:, held], control.target[:, held])


def test_free_pixels_do_not_bleed_into_a_smaller_constraint() -> None:
    target = torch.zeros(1, 32, 32, dtype=torch.float64)
    target[:, :, :16] = 1
    confidence = torch.zeros(32, 32, dtype=torch.float64)
    confidence[:, :16] = 1
    small = SoftConstraint(target, confidence).at(8, 8)
    held = small.confidence > 0
    assert held[:, :4].all()
    assert not held[:, 5:].any()
    torch.testing.assert_close(small.target[0][held], torch.ones(int(held.sum())).double())
    assert small.confidence.min() >= 0


def test_a_uniform_constraint_stays_so_at_any_size() -> None:
    control = SoftConstraint(torch.full((3, 20, 30), 0.3), torch.full((20, 30), 2.0))
    for size in ((5, 7), (20, 30), (41, 60)):
        other = control.at(*size)
        torch.testing.assert_close(other.target, torch.full((3, *size), 0.3))
        torch.testing.assert_close(other.confidence, torch.full(size, 2.0))


def test_a_guide_is_scaled_with_its_exemplars() -> None:
    guide = Guide([stripes(20, 31, 2), stripes(12, 12, 2)], stripes(40, 50, 2), 3.0)
    small = guide.at(0.5, 20, 25)
    assert [tuple(z.shape) for z in small.exemplars] == [(2, 10, 16), (2, 6, 6)]
    assert small.texture.shape == (2, 20, 25)
    assert small.weight == 3.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: SoftConstraint(noise(1, 4, 4), noise(4, 5)),
            "confidence is 4x5 and target is 4x4",
        ),
        (lambda: SoftConstraint(noise(1, 4, 4), -noise(4, 4)), "at least 0"),
        (lambda: SoftConstraint(noise(1, 4, 4), noise(4, 4) / 0), "finite"),
        (lambda: SoftConstraint(noise(1, 4, 4) / 0, noise(4, 4)), "target holds"),
        (lambda: Guide([noise(2, 4, 4)], noise(1, 4, 4)), "guide of the exemplar has 2 channels"),
        (lambda: Guide([noise(1, 4, 4)], noise(1, 4, 4), -1.0), "weight=-1.0"),
        (lambda: Guide([noise(1, 4, 4) / 0], noise(1, 4, 4)), "guide holds"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_wrong_controls_say_what_is_wrong(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_the_examples_run() -> None:
    assert doctest.testmod(controls).failed == 0
