"""Wavelets: equal to PyWavelets, inverse, adjoint, energy, shifts."""

import doctest

import numpy as np
import pytest
import pywt
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchtex import wavelets

NAMES = ["haar", *(f"db{n}" for n in range(1, 9)), "sym4", "coif1"]


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def noise(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def bands_of(coefficients: wavelets.Coefficients) -> list[Tensor]:
    details = [band for level in coefficients.details for band in level]
    return [coefficients.approximation, *details]


def energy(*bands: Tensor) -> Tensor:
    return torch.stack([band.square().sum() for band in bands]).sum()


# ---------------------------------------------------------------------------------- filters


def test_every_orthogonal_wavelet_is_accepted_and_no_other() -> None:
    for name in pywt.wavelist(kind="discrete"):
        if pywt.Wavelet(name).orthogonal and name != "dmey":  # orthogonal to 2e-3 only
            low, high = wavelets.filters(name)
            assert abs(sum(tap**2 for tap in low) - 1) < 1e-9
            assert abs(sum(high)) < 1e-6
        else:
            with pytest.raises(ValueError, match=f"wavelet='{name}' is not orthogonal; choose"):
                wavelets.filters(name)


def test_an_unknown_wavelet_gets_near_matches() -> None:
    with pytest.raises(ValueError, match=r"^wavelet='dB44' is unknown; try .*db4"):
        wavelets.filters("dB44")
    with pytest.raises(ValueError, match="wavelet='' is unknown; try haar or db2 or db4"):
        wavelets.stationary(noise(1, 8, 8), "", 2)


# -------------------------------------------------------------------------------- decimated


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(16, 24), (15, 22), (9, 7), (5, 64), (2, 3)])
def test_decompose_equals_pywavelets_and_reconstructs(name: str, size: tuple[int, int]) -> None:
    x = noise(2, *size)
    levels = min(3, (min(size) - 1).bit_length())
    ours = wavelets.decompose(x, name, levels)
    with pytest.MonkeyPatch.context() as patch:  # it warns of levels that the filter outgrows
        patch.setattr("warnings.warn", lambda *_, **__: None)
        theirs = pywt.wavedec2(x.numpy(), name, mode="periodization", level=levels)
    flat = [theirs[0], *(band for level in theirs[1:] for band in level)]
    for band, wanted in zip(bands_of(ours), flat, strict=True):
        assert np.abs(band.numpy() - wanted).max() < 1e-11
    assert (wavelets.reconstruct(ours) - x).abs().max() < 1e-10


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(NAMES), st.integers(1, 9), st.integers(1, 9), st.integers(1, 3), st.integers()
)
def test_even_sizes_keep_energy_and_the_inverse_is_the_adjoint(
    name: str, rows: int, cols: int, levels: int, seed: int
) -> None:
    x = noise(1, rows << levels, cols << levels, seed=seed % 2**32)
    ours = wavelets.decompose(x, name, levels)
    assert torch.allclose(energy(*bands_of(ours)), energy(x), rtol=1e-9)
    other = wavelets.decompose(noise(*x.shape, seed=1), name, levels)
    product = sum((a * b).sum() for a, b in zip(bands_of(ours), bands_of(other), strict=True))
    assert torch.allclose(torch.as_tensor(product), (x * wavelets.reconstruct(other)).sum())


def test_decompose_refuses_too_many_levels() -> None:
    for levels in (0, 4):
        with pytest.raises(ValueError, match=rf"levels={levels} must lie in 1..3 for 20 x 7"):
            wavelets.decompose(noise(1, 20, 7), "haar", levels)
    with pytest.raises(ValueError, match=r"wavelet='bior2.2' is not orthogonal"):
        wavelets.decompose(noise(1, 20, 7), "bior2.2", 1)


# ------------------------------------------------------------------------------- stationary


@pytest.mark.parametrize("name", NAMES)
def test_stationary_equals_pywavelets_up_to_a_shift(name: str) -> None:
    x = noise(16, 24)
    ours = wavelets.stationary(x[None], name, 3, boundary="periodic")[:, 0]
    theirs = pywt.swt2(x.numpy(), name, level=3, norm=True, trim_approx=True)
    flat = [theirs[0], *(band for level in theirs[1:] for band in level)]
    assert len(ours) == len(flat) == len(wavelets.band_names(3))
    for band, wanted in zip(ours.numpy(), flat, strict=True):
        match = np.fft.ifft2(np.fft.fft2(band) * np.fft.fft2(wanted).conj()).real
        shift = np.unravel_index(match.argmax(), match.shape)
        assert np.abs(band - np.roll(wanted, shift, (0, 1))).max() < 1e-9


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(NAMES),
    st.integers(1, 20),
    st.integers(1, 20),
    st.integers(1, 4),
    st.integers(-30, 30),
)
def test_periodic_keeps_energy_and_commutes_with_shifts(
    name: str, h: int, w: int, levels: int, shift: int
) -> None:
    x = noise(2, h, w)
    bands = wavelets.stationary(x, name, levels, boundary="periodic")
    assert bands.shape == (1 + 3 * levels, 2, h, w)
    assert torch.allclose(energy(bands), energy(x), rtol=1e-9)
    moved = wavelets.stationary(x.roll((shift, 1), (1, 2)), name, levels, boundary="periodic")
    assert torch.equal(moved, bands.roll((shift, 1), (2, 3)))


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(NAMES), st.integers(1, 14), st.integers(1, 14), st.integers(1, 3))
def test_reflect_is_the_periodic_transform_of_the_mirrored_image(
    name: str, h: int, w: int, levels: int
) -> None:
    x = noise(2, h, w)
    mirrored = torch.cat([x, x[:, 1 : h - 1].flip(1)], 1)
    mirrored = torch.cat([mirrored, mirrored[:, :, 1 : w - 1].flip(2)], 2)
    wanted = wavelets.stationary(mirrored, name, levels, boundary="periodic")[..., :h, :w]
    assert torch.equal(wavelets.stationary(x, name, levels), wanted)


@pytest.mark.parametrize("name", NAMES)
def test_coefficients_sit_at_the_centre_of_what_they_see(name: str) -> None:
    size, levels = 64, 2
    x = torch.zeros(1, size, size, dtype=torch.float64, requires_grad=True)
    bands = wavelets.stationary(x, name, levels)[:, 0, size // 2, size // 2]
    place = torch.arange(size, dtype=torch.float64)
    for band in bands:
        (seen,) = torch.autograd.grad(band, x, retain_graph=True)
        weight = seen[0].square() / energy(seen)
        for axis in (0, 1):
            offset = (weight.sum(1 - axis) * place).sum() - size // 2
            assert offset.abs() < 0.5 + 1e-6


def test_bands_are_named_for_the_edges_that_they_show() -> None:
    rows = (torch.arange(32) % 2).double()  # the finest horizontal stripes
    stripes = rows[:, None].expand(1, 32, 32)
    for image, finest in ((stripes, "horizontal 1"), (stripes.mT, "vertical 1")):
        bands = wavelets.stationary(image, "db2", 3)[:, 0]
        names = wavelets.band_names(3)
        loud = names[1 + int(bands[1:].square().sum((1, 2)).argmax())]
        assert loud == finest
        assert torch.allclose(bands[0], torch.full_like(bands[0], 0.5))
    decimated = wavelets.decompose(stripes, "db2", 1).details[0]
    assert decimated[0].abs().mean() > 0.1
    assert decimated[1].abs().max() < 1e-9


@pytest.mark.parametrize("boundary", ["reflect", "periodic"])
def test_float32_comes_back_and_is_close(boundary: wavelets.Boundary) -> None:
    x = noise(3, 20, 17)
    wanted = wavelets.stationary(x, "db4", 3, boundary=boundary)
    bands = wavelets.stationary(x.float(), "db4", 3, boundary=boundary)
    assert bands.dtype == torch.float32
    assert (bands - wanted).abs().max() < 1e-6
    assert wavelets.decompose(x.float(), "db4", 3).approximation.dtype == torch.float32


def test_stationary_refuses_bad_settings() -> None:
    x = noise(1, 8, 8)
    for levels in (0, 9):
        with pytest.raises(ValueError, match=rf"levels={levels} must lie in 1..8"):
            wavelets.stationary(x, "haar", levels)
    unchecked = getattr(wavelets.stationary, "__wrapped__", wavelets.stationary)
    with pytest.raises(ValueError, match=r"boundary='zero' must be \"reflect\" or \"periodic\""):
        unchecked(x, "haar", 1, boundary="zero")


# ---------------------------------------------------------------------------------- windows


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("size", "levels"), [(8, 1), (8, 3), (12, 2), (2, 1)])
def test_window_matrix_is_orthonormal_and_equals_pywavelets(
    name: str, size: int, levels: int
) -> None:
    w = wavelets.window_matrix(size, name, levels)
    assert torch.allclose(w @ w.T, torch.eye(size, dtype=torch.float64), atol=1e-9)
    x = noise(size)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *_, **__: None)
        wanted = pywt.wavedec(x.numpy(), name, mode="periodization", level=levels)
    assert np.abs((w @ x).numpy() - np.concatenate(wanted)).max() < 1e-11


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("size", "levels"), [(8, 1), (8, 3), (12, 2)])
def test_window_transform_equals_pywavelets(name: str, size: int, levels: int) -> None:
    patches = noise(3, size, size, 2)
    ours = wavelets.window_transform(patches, name, levels)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *_, **__: None)
        theirs = pywt.wavedec2(
            patches.numpy(), name, mode="periodization", level=levels, axes=(1, 2)
        )
    wanted, _ = pywt.coeffs_to_array(theirs, axes=(1, 2))
    assert np.abs(ours.numpy() - wanted).max() < 1e-11


@pytest.mark.parametrize("name", ["haar", "db2", "db4"])
def test_window_transform_keeps_distances_and_bands_split_them(name: str) -> None:
    a, b = noise(5, 8, 8, 3), noise(5, 8, 8, 3, seed=1)
    difference = wavelets.window_transform(a, name, 2) - wavelets.window_transform(b, name, 2)
    assert torch.allclose(difference.square().sum((1, 2, 3)), (a - b).square().sum((1, 2, 3)))
    bands = wavelets.window_bands(8, 2)
    flat = wavelets.window_transform(torch.ones_like(a), name, 2)
    assert (flat[:, bands > 0]).abs().max() < 1e-9
    assert torch.allclose(flat[:, bands == 0], torch.tensor(4.0, dtype=torch.float64))
    rows = (torch.arange(8) % 2).double()[:, None, None].expand(1, 8, 8, 1)
    loud = wavelets.window_transform(rows, name, 2)[0, :, :, 0].abs() > 1e-6
    names = {wavelets.band_names(2)[int(band)] for band in bands[loud]}
    assert names == {"approximation", "horizontal 1"}


def test_window_bands_count() -> None:
    for size, levels in ((8, 3), (12, 2), (2, 1)):
        counts = wavelets.window_bands(size, levels).flatten().bincount().tolist()
        corner = (size >> levels) ** 2
        wanted = [corner] + [corner << 2 * i for i in range(levels) for _ in range(3)]
        assert counts == wanted


def test_windows_that_cannot_be_halved_are_refused() -> None:
    for call in (
        lambda: wavelets.window_matrix(6, "haar", 2),
        lambda: wavelets.window_bands(6, 2),
        lambda: wavelets.window_transform(noise(1, 6, 6, 1), "haar", 2),
    ):
        with pytest.raises(ValueError, match=r"size=6 cannot be halved levels=2 times; .* of 4"):
            call()
    with pytest.raises(ValueError, match="levels=0 must be at least 1"):
        wavelets.window_bands(6, 0)


# -------------------------------------------------------------------------------- gradients


def stationary_of(boundary: wavelets.Boundary, x: Tensor) -> Tensor:
    return wavelets.stationary(x, "db2", 2, boundary=boundary)


MAPS = {
    "reflect": lambda x: stationary_of("reflect", x),
    "periodic": lambda x: stationary_of("periodic", x),
    "decompose": lambda x: tuple(bands_of(wavelets.decompose(x, "db2", 2))),
    "round trip": lambda x: wavelets.reconstruct(wavelets.decompose(x, "db2", 2)),
    "windows": lambda x: wavelets.window_transform(x[:, :4, :4, None], "db2", 2),
}


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")  # forward mode
@pytest.mark.parametrize("name", MAPS)
def test_gradients(name: str) -> None:
    x = noise(1, 5, 4).requires_grad_()
    checks = {"check_forward_ad": True, "check_batched_grad": True}
    assert torch.autograd.gradcheck(MAPS[name], x, **checks)
    assert torch.autograd.gradgradcheck(MAPS[name], x)


@pytest.mark.parametrize("name", MAPS)
def test_all_are_linear(name: str) -> None:
    def flat(x: Tensor) -> Tensor:
        out = MAPS[name](x)
        return torch.cat([part.flatten() for part in (out if isinstance(out, tuple) else (out,))])

    a, b = noise(2, 9, 7), noise(2, 9, 7, seed=1)
    assert torch.allclose(flat(2 * a - 3 * b), 2 * flat(a) - 3 * flat(b))


def test_the_examples_run() -> None:
    assert doctest.testmod(wavelets).failed == 0
