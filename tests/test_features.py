"""Features: linear ones are linear; gradients by hand; wavelets in both modes; stacks."""

import doctest
from collections.abc import Callable

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex import features, wavelets
from torchtex.features import (
    Feature,
    Gradients,
    Pixels,
    Stack,
    Wavelets,
    Windowed,
    as_windowed,
    is_linear,
)

LINEAR = [
    Pixels(),
    Gradients(),
    Gradients(mu=0.0),
    Wavelets(),
    Wavelets("db2", levels=1),
    Wavelets("db4", levels=3, weights=(0.0, 1.0, 2.0, 0.5)),
    Wavelets(mode="window"),
    Stack((Pixels(), Gradients(mu=2.0)), (0.5, 3.0)),
    Stack((Wavelets("db3"), Pixels())),
]


@pytest.mark.parametrize("feature", LINEAR, ids=repr)
def test_linear_features_are_linear_and_keep_the_size(feature: Feature) -> None:
    assert is_linear(feature)
    assert isinstance(feature, Feature)
    x, y = noise(3, 19, 22, seed=1), noise(3, 19, 22, seed=2)
    assert feature(x).shape[1:] == x.shape[1:]
    assert feature(x).dtype == x.dtype
    torch.testing.assert_close(feature(2 * x - 0.7 * y), 2 * feature(x) - 0.7 * feature(y))
    assert feature(torch.zeros_like(x)).abs().max() == 0
    assert feature(x.float()).dtype == torch.float32


def test_pixels_are_the_image_itself() -> None:
    x = noise(2, 5, 6)
    assert torch.equal(Pixels()(x), x)


def test_gradients_by_hand() -> None:
    x = torch.tensor([[[1.0, 2.0, 4.0], [0.0, 3.0, 3.0]]], dtype=torch.float64)
    down = torch.tensor([[-1.0, 1.0, -1.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    right = torch.tensor([[1.0, 2.0, 0.0], [3.0, 0.0, 0.0]], dtype=torch.float64)
    root = 10**0.5
    torch.testing.assert_close(Gradients()(x), torch.stack([x[0], root * down, root * right]))
    energy = x.square().sum() + 10 * (down.square().sum() + right.square().sum())
    torch.testing.assert_close(Gradients(mu=10.0)(x).square().sum(), energy)


def test_stationary_wavelets_are_the_weighted_bands() -> None:
    x = noise(2, 16, 17)
    bands = wavelets.stationary(x, "db2", 2)
    feature = Wavelets("db2", weights=(4.0, 0.25, 0.0))(x).view(7, 2, 16, 17)
    torch.testing.assert_close(feature[0], 2 * bands[0])
    torch.testing.assert_close(feature[1:4], 0.5 * bands[1:4])
    assert feature[4:].abs().max() == 0
    torch.testing.assert_close(
        Wavelets("db2", detail=9.0)(x), Wavelets("db2", weights=(1.0, 9.0, 9.0))(x)
    )


@pytest.mark.parametrize("wavelet", ["haar", "db2", "db3"])
@pytest.mark.parametrize("size", [4, 8, 12, 16])
def test_unit_weights_inside_the_window_are_the_pixel_distance(wavelet: str, size: int) -> None:
    feature = Wavelets(wavelet, mode="window", levels=2, weights=(1.0, 1.0, 1.0))
    patches = noise(9, size, size, 3)
    vectors = feature.window(patches).reshape(9, -1)
    torch.testing.assert_close(
        torch.cdist(vectors, vectors), torch.cdist(*[patches.flatten(1)] * 2)
    )


def test_other_weights_inside_the_window_are_another_distance() -> None:
    patches = noise(6, 8, 8, 1)
    plain = torch.cdist(*[patches.flatten(1)] * 2)
    for weights in ((1.0, 4.0, 4.0), (1.0, 1.0, 0.0)):
        vectors = Wavelets(mode="window", weights=weights).window(patches).flatten(1)
        assert not torch.allclose(torch.cdist(vectors, vectors), plain)


def test_dropping_every_detail_leaves_block_means() -> None:
    patches = noise(4, 8, 8, 2)
    feature = Wavelets(mode="window", weights=(1.0, 0.0, 0.0))
    means = patches.view(4, 2, 4, 2, 4, 2).mean((2, 4)) * 4
    kept = feature.window(patches)
    torch.testing.assert_close(kept.square().sum((1, 2)), means.square().sum((1, 2)))


@pytest.mark.parametrize("size", [2, 6, 8, 10])
def test_a_window_too_small_for_all_levels_takes_fewer(size: int) -> None:
    feature = Wavelets(mode="window", levels=3)
    patches = noise(3, size, size, 2)
    assert feature.window(patches).shape == patches.shape


def test_only_one_mode_acts_in_the_window() -> None:
    image = noise(2, 16, 16)
    assert isinstance(Wavelets(), Windowed)
    assert as_windowed(Wavelets()) is None
    assert as_windowed(Wavelets(mode="window")) == Wavelets(mode="window")
    assert torch.equal(Wavelets(mode="window")(image), image)


def test_stacked_squared_distances_add_up() -> None:
    x = stripes(16, 18)
    stack = Stack((Pixels(), Gradients(mu=3.0), Wavelets()), (0.5, 2.0, 0.0))
    expected = 0.5 * x.square().sum() + 2 * Gradients(mu=3.0)(x).square().sum()
    torch.testing.assert_close(stack(x).square().sum(), expected)
    torch.testing.assert_close(Stack((Pixels(), Pixels()))(x).square().sum(), 2 * x.square().sum())


def test_any_callable_is_a_feature_and_is_not_taken_for_linear() -> None:
    def local_contrast(image: Tensor) -> Tensor:
        return image.square()

    assert isinstance(local_contrast, Feature)
    assert not is_linear(local_contrast)
    assert not Stack((Pixels(), local_contrast)).linear
    assert not is_linear(Stack((Pixels(), local_contrast)))
    assert is_linear(Stack((Pixels(), Wavelets())))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Gradients(mu=-1.0), "mu=-1.0 must be at least 0"),
        (lambda: Gradients(mu=float("nan")), "mu=nan"),
        (lambda: Wavelets("nope"), "nope"),
        (lambda: Wavelets("bior2.2"), "bior2.2"),
        (lambda: Wavelets(levels=0), "levels=0"),
        (lambda: Wavelets(weights=(1.0, 1.0)), "must be 3 numbers"),
        (lambda: Wavelets(weights=()), "must be 3 numbers"),
        (lambda: Wavelets(weights=(1.0, -1.0, 1.0)), "at least 0"),
        (lambda: Wavelets(detail=-2.0), "detail=-2"),
        (lambda: Stack(()), "give at least one"),
        (lambda: Stack((Pixels(),), (1.0, 2.0)), "must be 1 numbers"),
        (lambda: Stack((Pixels(),), (-1.0,)), "at least 0"),
        (lambda: Stack((Pixels(), Wavelets(mode="window"))), "cannot be stacked"),
    ],
)
def test_wrong_settings_say_what_is_wrong(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_the_examples_run() -> None:
    assert doctest.testmod(features).failed == 0
