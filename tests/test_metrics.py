"""The measures: their formulas, what they catch, and what fools each of them alone."""

import doctest
import math

import jaxtyping
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from kornia.filters import gaussian_blur2d
from torch import Tensor

from torchtex import data, metrics

NAMES = ["nn", "tail", "miss", "swd", "spec", "copy", "repeat"]


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(shape, generator=seeded(seed), dtype=dtype)


def soft(*shape: int, seed: int = 0) -> Tensor:
    """A smooth random texture that tiles."""
    x = F.pad(noise(*shape, seed=seed)[None], (9, 9, 9, 9), mode="circular")
    x = gaussian_blur2d(x, (9, 9), (1.5, 1.5))[0, :, 9:-9, 9:-9]
    return (x - x.min()) / (x.max() - x.min())


def blurred(image: Tensor, sigma: float) -> Tensor:
    return gaussian_blur2d(image[None], (13, 13), (sigma, sigma))[0]


def shuffled(image: Tensor) -> Tensor:
    order = torch.randperm(image[0].numel(), generator=seeded())
    return image.flatten(1)[:, order].view_as(image)


def blocks(exemplar: Tensor, side: int, block: int) -> Tensor:
    """Random blocks of the exemplar with hard edges."""
    corners = torch.randint(
        0, exemplar.shape[1] - block + 1, (side // block, side // block, 2), generator=seeded()
    )
    rows = [
        torch.cat([exemplar[:, y : y + block, x : x + block] for y, x in row], 2)
        for row in corners.tolist()
    ]
    return torch.cat(rows, 1)


def phase_noise(exemplar: Tensor, side: int) -> Tensor:
    """Gaussian noise with the spectrum of the exemplar."""
    mean = exemplar.mean((1, 2), keepdim=True)
    kernel = torch.zeros(exemplar.shape[0], side, side)
    kernel[:, : exemplar.shape[1], : exemplar.shape[2]] = exemplar - mean
    white = torch.randn(side, side, generator=seeded()) / math.sqrt(exemplar[0].numel())
    spectrum = torch.fft.fft2(kernel) * torch.fft.fft2(white)
    return (mean + torch.fft.ifft2(spectrum).real).clamp(0, 1)


def scores(name: str, *wanted: str) -> dict[str, dict[str, float]]:
    """All measures of fakes of one exemplar, and of the rest of its photo (`real`)."""
    photo = data.load(name)
    exemplar = photo[:, :64, :64]
    tile = exemplar.repeat(1, 2, 2)
    fakes = {
        "tile": tile,
        "blur": blurred(tile, 1.5),
        "flat": exemplar.mean((1, 2), keepdim=True).expand_as(tile),
        "one patch": exemplar[:, 24:40, 24:40].repeat(1, 8, 8),
        "blocks": blocks(exemplar, 128, 16),
        "phase noise": phase_noise(exemplar, 128),
        "shuffled": shuffled(tile),
        "real": photo[:, 64:],
    }
    return {fake: metrics.battery(fakes[fake], exemplar) for fake in wanted or fakes}


@pytest.fixture(scope="module")
def gravel() -> dict[str, dict[str, float]]:
    torch.set_num_threads(1)
    return scores("gravel")


@pytest.fixture(scope="module")
def bricks() -> dict[str, dict[str, float]]:
    torch.set_num_threads(1)
    return scores("bricks", "blur", "one patch", "blocks", "phase noise", "real")


@pytest.mark.parametrize(
    ("fake", "caught", "fooled"),
    [
        ("tile", ["copy", "repeat"], ["nn", "tail", "miss", "swd", "spec"]),
        ("blur", ["swd", "spec", "repeat"], ["nn", "tail", "copy"]),
        ("flat", ["miss", "swd", "spec"], ["nn", "tail", "copy", "repeat"]),
        ("one patch", ["miss", "swd", "spec", "repeat"], ["nn"]),
        ("blocks", ["tail"], ["nn", "miss", "swd", "spec", "repeat"]),
        ("phase noise", ["nn", "miss"], ["swd", "spec", "copy", "repeat"]),
        ("shuffled", ["nn", "tail", "miss", "swd", "spec"], ["copy", "repeat"]),
    ],
)
def test_each_fake_is_caught_and_fools_the_rest(
    gravel: dict[str, dict[str, float]], fake: str, caught: list[str], fooled: list[str]
) -> None:
    real, ours = gravel["real"], gravel[fake]
    for name in caught:
        margin = 0.2 if name in ("copy", "repeat") else 0.05 * real[name]
        assert ours[name] > real[name] + margin, name
    for name in fooled:
        assert ours[name] < max(0.05, real[name]) * 1.3, name


def test_structure_that_is_broken_or_lost_shows_on_bricks(
    bricks: dict[str, dict[str, float]],
) -> None:
    real = bricks["real"]
    assert bricks["blocks"]["tail"] > 2 * real["tail"]
    assert bricks["phase noise"]["nn"] > 3 * real["nn"]
    assert bricks["phase noise"]["miss"] > 2 * real["miss"]
    assert bricks["blur"]["miss"] > 2 * real["miss"]
    assert bricks["one patch"]["miss"] > 5 * real["miss"]


def test_the_numbers_of_known_pictures(gravel: dict[str, dict[str, float]]) -> None:
    assert gravel["tile"]["copy"] == pytest.approx(4 * 58**2 / 122**2, abs=0.005)
    assert gravel["flat"]["miss"] == pytest.approx(1, abs=0.01)
    assert gravel["flat"]["swd"] == pytest.approx(math.sqrt(2 / math.pi), abs=0.02)  # a Gaussian
    assert gravel["flat"]["spec"] > 10
    assert gravel["tile"]["repeat"] > 0.7
    assert gravel["real"]["repeat"] < 0.1


def test_the_exemplar_itself_is_perfect_but_a_copy() -> None:
    exemplar = soft(3, 40, 33)
    values = metrics.battery(exemplar, exemplar, tileable=True)
    assert list(values) == [*NAMES, "seam", "seam_worst"]
    for name in ("nn", "tail", "miss"):
        assert values[name] < 1e-9
    assert values["swd"] == values["spec"] == 0
    assert values["copy"] == 1
    assert values["repeat"] <= 0


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_patch_distances_equal_brute_force(channels: int) -> None:
    exemplar, texture = soft(channels, 24, 20, seed=1), soft(channels, 18, 30, seed=2)
    for patch in (5, 7):
        s, e = (F.unfold(x[None], patch)[0].T for x in (texture, exemplar))
        squared = (s[:, None] - e).square().sum(2)
        unit = (e - e.mean(0)).square().sum(1).mean()
        nearest = squared.amin(1) / unit
        options = {"patch": patch, "exact": True}
        assert metrics.nn(texture, exemplar, **options) == pytest.approx(nearest.mean().item())
        assert metrics.tail(texture, exemplar, **options) == pytest.approx(
            nearest.quantile(0.99, interpolation="nearest").item()
        )
        assert metrics.miss(texture, exemplar, **options) == pytest.approx(
            (squared.amin(0).mean() / unit).item()
        )


def test_the_fast_search_stays_within_its_margins() -> None:
    photo = data.load("tissue")
    exemplar = photo[:, :48, :48]
    texture = torch.cat([photo[:, :, 64:], blocks(exemplar, 128, 32)], 2)
    assert 124 * 188 > 20000  # else `tail` would look at all patches anyway
    exact, fast = (metrics.battery(texture, exemplar, exact=choice) for choice in (True, False))
    assert exact["nn"] - 1e-6 <= fast["nn"] <= exact["nn"] + 0.0005
    assert exact["miss"] - 0.004 <= fast["miss"] <= exact["miss"] + 1e-6
    assert fast["tail"] == pytest.approx(exact["tail"], rel=0.06)
    assert fast["copy"] == pytest.approx(exact["copy"], abs=0.002)
    assert all(fast[name] == exact[name] for name in ("swd", "spec", "repeat"))


@pytest.mark.parametrize("measure", [metrics.nn, metrics.miss, metrics.copy])
def test_the_battery_shares_one_search(measure) -> None:
    exemplar, texture = soft(3, 24, 24, seed=1), soft(3, 32, 24, seed=2)
    assert metrics.battery(texture, exemplar)[measure.__name__] == measure(texture, exemplar)


def test_copy_counts_the_patches_of_a_pasted_exemplar() -> None:
    exemplar, texture = noise(1, 20, 24, seed=1), noise(1, 40, 50, seed=2)
    assert metrics.copy(texture, exemplar) < 0.02
    texture[:, 7:27, 11:35] = exemplar
    whole = (20 - 6) * (24 - 6) / ((40 - 6) * (50 - 6))
    assert metrics.copy(texture, exemplar) == pytest.approx(whole, abs=0.02)


def flood(value: Tensor) -> list[int]:
    """Regions by walking, one pixel at a time."""
    h, w = value.shape
    root = [-1] * (h * w)
    for start in range(h * w):
        stack = [start] if root[start] < 0 else []
        while stack:
            site = stack.pop()
            root[site] = start
            y, x = divmod(site, w)
            for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                near = 0 <= v < h and 0 <= u < w and value[v, u] == value[y, x]
                if near and root[v * w + u] < 0:
                    stack.append(v * w + u)
    return root


@settings(max_examples=60, deadline=None)
@given(
    hnp.arrays(
        "int64", hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(0, 2)
    )
)
def test_regions_equal_a_flood_fill(value) -> None:
    value = torch.from_numpy(value)
    assert metrics._components(value).tolist() == flood(value)


def test_a_winding_region_is_one() -> None:
    snake = torch.zeros(41, 40, dtype=torch.long)
    snake[1::4, :-1] = snake[3::4, 1:] = 1
    assert metrics._components(snake)[snake.flatten() == 0].unique().tolist() == [0]


def test_swd_is_proportional_to_a_shift_of_all_colours() -> None:
    exemplar = soft(3, 40, 40)
    once, twice = (metrics.swd(exemplar + shift, exemplar, scales=1) for shift in (0.1, 0.2))
    assert twice == pytest.approx(2 * once)
    assert once > 0.1


def test_swd_equals_sorted_projections_of_equal_sets() -> None:
    exemplar, texture = soft(1, 30, 30, seed=1), soft(1, 30, 30, seed=2)
    w = F.normalize(torch.randn(128, 49, generator=seeded(), dtype=torch.float64), dim=1)
    ours, theirs = (w @ F.unfold(x[None], 7)[0] for x in (texture, exemplar))
    gap = (ours.sort(1).values - theirs.sort(1).values).abs().mean(1) / theirs.std(1)
    assert metrics.swd(texture, exemplar, scales=1) == pytest.approx(gap.mean().item(), rel=0.02)


def test_swd_survives_a_pattern_that_vanishes_at_coarse_scales() -> None:
    checks = (torch.arange(32)[:, None] + torch.arange(32)) % 2
    checks = checks[None].double()
    assert metrics.swd(checks, checks) == 0
    assert math.isfinite(metrics.swd(noise(1, 32, 32), checks))


def test_spec_counts_powers_of_ten() -> None:
    exemplar = noise(3, 70, 100)
    assert metrics.spec(exemplar / 2, exemplar) == pytest.approx(math.log10(4))
    assert metrics.spec(exemplar + 0.3, exemplar) == pytest.approx(0, abs=1e-9)
    assert metrics.spec(exemplar[:, :40], exemplar) > 0  # both are then seen through 32 px
    turned = (x.transpose(1, 2) for x in (exemplar / (1 + soft(3, 70, 100)), exemplar))
    upright = metrics.spec(exemplar / (1 + soft(3, 70, 100)), exemplar)
    assert metrics.spec(*turned) == pytest.approx(upright)


def test_spec_sees_orientation() -> None:
    stripes = torch.sin(torch.arange(64) * 0.7).double().expand(1, 64, 64) + noise(1, 64, 64)
    assert metrics.spec(stripes.transpose(1, 2), stripes) > 0.2


def test_more_blur_is_worse() -> None:
    photo = data.load("gravel")[:, :64]
    textures = [blurred(photo, sigma) for sigma in (0.5, 1.0, 2.0)]
    for measure in (metrics.spec, metrics.swd, metrics.miss):
        low, middle, high = (measure(texture, photo[:, :, :64]) for texture in textures)
        assert low < middle < high, measure.__name__


@pytest.mark.parametrize("side", [48, 72])
def test_repeat_finds_a_tiling_that_is_cut_off(side: int) -> None:
    exemplar = soft(1, 40, 40)
    tiled = exemplar.repeat(1, 2, 2)[:, :side, :72]
    assert metrics.repeat(tiled, exemplar) > 0.5
    assert metrics.repeat(soft(1, side, 72, seed=1), exemplar) < 0.2


def test_seam_is_one_for_a_texture_that_tiles() -> None:
    tiles, ramp = soft(3, 48, 64), torch.linspace(0, 1, 48).expand(3, 48, 48)
    assert metrics.seam(tiles) == pytest.approx(1, abs=0.25)
    assert metrics.seam(tiles, segment=16) == pytest.approx(1, abs=0.35)
    assert metrics.seam(ramp) == pytest.approx(47, rel=1e-3)
    assert metrics.seam(ramp.transpose(1, 2)) == pytest.approx(47, rel=1e-3)
    assert metrics.seam(torch.full((1, 8, 8), 0.5)) == 1


def test_a_short_bad_stretch_hides_in_the_mean() -> None:
    torn = soft(1, 128, 64)
    torn[:, 40:56, 0] = (torn[:, 40:56, 0] + 0.3) % 1
    assert metrics.seam(torn) < 1.8
    assert metrics.seam(torn, segment=16) > 1.5 * metrics.seam(torn)


def test_a_blurred_border_fools_seam_but_not_the_strip_around_it() -> None:
    photo = data.load("gravel")
    exemplar, texture = photo[:, :, :64], photo[:, :, 64:]
    strip = torch.cat([texture[:, :, -16:], texture[:, :, :16]], 2)
    hidden = blurred(strip, 3)
    repaired = torch.cat([hidden[:, :, 16:], texture[:, :, 16:-16], hidden[:, :, :16]], 2)
    columns = (repaired - repaired.roll(-1, 2)).abs().mean((0, 1))
    assert columns[-1] < columns[:-1].mean()
    assert metrics.spec(hidden, exemplar) > 3 * metrics.spec(texture[:, :, 16:48], exemplar)


def test_diversity_tells_seeds_from_copies() -> None:
    exemplar = soft(3, 32, 32)
    same = [exemplar, exemplar, exemplar]
    assert metrics.diversity(same, exemplar) == 0
    fresh = [soft(3, 40, 40, seed=seed) for seed in (1, 2, 3)]
    assert 0.7 < metrics.diversity(fresh, exemplar) < 1.3
    half = [*fresh[:1], *fresh[:1], fresh[1]]
    pair = metrics.diversity(fresh[:2], exemplar)
    assert metrics.diversity(half, exemplar) == pytest.approx(2 / 3 * pair)


def test_results_ignore_and_leave_the_global_generator() -> None:
    exemplar, texture = soft(3, 24, 24), soft(3, 32, 32, seed=1)
    torch.manual_seed(1)
    state = torch.get_rng_state()
    first = metrics.battery(texture, exemplar)
    spread = metrics.diversity([texture, texture.flip(1)], exemplar)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(2)
    assert metrics.battery(texture, exemplar) == first
    assert metrics.diversity([texture, texture.flip(1)], exemplar) == spread
    assert metrics.battery(texture, exemplar, seed=1)["swd"] != first["swd"]


@pytest.mark.parametrize(
    ("dtype", "margin"), [(torch.float32, 1e-4), (torch.float16, 5e-3), (torch.bfloat16, 5e-2)]
)
def test_any_floating_dtype(dtype: torch.dtype, margin: float) -> None:
    exemplar, texture = soft(3, 24, 24), soft(3, 32, 32, seed=1)
    double = metrics.battery(texture, exemplar, tileable=True)
    ours = metrics.battery(texture.to(dtype), exemplar.to(dtype), tileable=True)
    del double["copy"], ours["copy"]  # rounding breaks the ties of nearest patches
    assert ours == pytest.approx(double, abs=margin)


def test_grey_is_grey_in_one_channel_or_three() -> None:
    exemplar, texture = soft(1, 24, 24), soft(1, 32, 32, seed=1)
    one = metrics.battery(texture, exemplar, tileable=True)
    three = metrics.battery(texture.repeat(3, 1, 1), exemplar.repeat(3, 1, 1), tileable=True)
    for name in sorted({*one} - {"swd", "miss"}):  # other directions; another rest of the axes
        assert three[name] == pytest.approx(one[name], abs=1e-6), name
    assert three["miss"] == pytest.approx(one["miss"], abs=2e-3)


@pytest.mark.parametrize("shape", [(1, 8, 8), (2, 9, 17), (5, 30, 8)])
def test_small_images_and_any_number_of_channels(shape: tuple[int, int, int]) -> None:
    values = metrics.battery(noise(shape[0], 12, 31), noise(*shape, seed=1), tileable=True)
    assert all(math.isfinite(value) for value in values.values())


def test_images_that_require_gradients_are_welcome() -> None:
    exemplar, texture = soft(1, 16, 16), soft(1, 16, 16, seed=1).requires_grad_()
    assert metrics.battery(texture, exemplar)["nn"] > 0


GOOD = noise(3, 16, 16)
HOLED = GOOD.clone()
HOLED[0, 3, 3] = math.nan


@pytest.mark.parametrize(
    ("texture", "exemplar", "message"),
    [
        (GOOD[0], GOOD, r"texture has shape \(16, 16\); give one image"),
        (GOOD, GOOD[None], r"exemplar has shape \(1, 3, 16, 16\)"),
        (GOOD[:, :5], GOOD, "texture of 5 x 16 px is too small; give 8 px or more"),
        (GOOD, GOOD[:, :, :7], "exemplar of 16 x 7 px is too small; give 8 px or more"),
        (GOOD[:1], GOOD, "texture has 1 channels, exemplar 3; convert"),
        (HOLED, GOOD, "texture holds NaN or infinite values; replace"),
        (GOOD, HOLED / 0, "exemplar holds NaN or infinite values"),
        ((GOOD * 255).byte(), GOOD, "texture has dtype torch.uint8; convert"),
        (GOOD, torch.full_like(GOOD, 0.3), "exemplar is a single flat colour"),
    ],
)
@pytest.mark.parametrize("name", ["nn", "miss", "copy", "swd", "spec", "repeat", "battery"])
def test_bad_images_get_one_clear_sentence(
    monkeypatch: pytest.MonkeyPatch, name: str, texture: Tensor, exemplar: Tensor, message: str
) -> None:
    # the shape checks are for tests; without them the functions still have to say what is wrong
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match=message):
        getattr(metrics, name)(texture, exemplar)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: metrics.nn(GOOD, GOOD, patch=0), "patch=0 must be at least 1"),
        (lambda: metrics.tail(GOOD, GOOD, patch=16), "texture of 16 x 16 px .* give 17 px"),
        (lambda: metrics.tail(GOOD, GOOD, quantile=99), r"quantile=99 must lie in 0\.\.1"),
        (lambda: metrics.swd(GOOD, GOOD, directions=0), "directions=0 must be at least 1"),
        (lambda: metrics.spec(GOOD, GOOD, window=48), "window=48 must be a power of two"),
        (lambda: metrics.seam(GOOD, segment=17), r"segment=17 must lie in 1\.\.16"),
        (lambda: metrics.diversity([GOOD], GOOD), "textures holds 1 image; give two"),
        (
            lambda: metrics.diversity([GOOD, GOOD, GOOD[:, 1:]], GOOD),
            "textures of 16 x 16 and 15 x 16 px cannot be compared",
        ),
        (
            lambda: metrics.repeat(noise(1, 8, 8), noise(1, 64, 64)),
            "texture of 8 x 8 px has no shift of 16 px",
        ),
    ],
)
def test_bad_options_get_one_clear_sentence(
    monkeypatch: pytest.MonkeyPatch, call, message: str
) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match=message):
        call()


def test_the_examples_run() -> None:
    result = doctest.testmod(metrics)
    assert result.failed == 0
    assert result.attempted >= 9
