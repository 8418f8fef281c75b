"""Search: every index obeys one contract; completeness and axes by direct formulas."""

import doctest

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex import matching
from torchtex.matching import (
    Chunked,
    Clustered,
    Exact,
    Index,
    Matcher,
    complete_search,
    principal_axes,
    two_sided_minima,
)

EXACT = [
    Exact(),
    Chunked(),
    Chunked(chunk=7),
    Clustered(),
    Clustered(clusters=6, probes=6, least=0),
    Clustered(clusters=1000, probes=2000, least=0),
]
APPROXIMATE = [Clustered(least=0, probes=1), Clustered(clusters=12, probes=2, least=0)]


def brute_force(queries: Tensor, keys: Tensor) -> Tensor:
    return (queries[:, None] - keys[None]).square().sum(2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("matcher", [*EXACT, *APPROXIMATE], ids=repr)
def test_index_contract(matcher: Matcher, dtype: torch.dtype) -> None:
    keys, queries = noise(150, 11, seed=1, dtype=dtype), noise(40, 11, seed=2, dtype=dtype)
    before = keys.clone()
    index = matcher.fit(keys)
    assert isinstance(matcher, Matcher)
    assert isinstance(index, Index)
    distances, labels = index.search(queries, 5)
    assert torch.equal(keys, before)
    assert distances.dtype == dtype
    assert labels.dtype == torch.int64
    assert distances.shape == labels.shape == (40, 5)
    assert labels.min() >= 0
    assert labels.max() < 150
    assert (distances.diff(dim=1) >= 0).all()
    table = brute_force(queries, keys)
    close = {"rtol": 1e-4, "atol": 1e-5} if dtype == torch.float32 else {"rtol": 1e-9, "atol": 1e-9}
    if matcher in EXACT:
        nearest, order = table.sort(dim=1)
        torch.testing.assert_close(distances, nearest[:, :5], **close)
        assert torch.equal(labels, order[:, :5])
    else:
        torch.testing.assert_close(distances[:, 0], table.gather(1, labels)[:, 0], **close)
        assert (labels[:, 0] == table.argmin(1)).double().mean() > 0.3


@pytest.mark.parametrize("matcher", [*EXACT, *APPROXIMATE], ids=repr)
def test_every_key_finds_itself(matcher: Matcher) -> None:
    keys = noise(300, 6, seed=3)
    distances, labels = matcher.fit(keys).search(keys, 1)
    assert torch.equal(labels[:, 0], torch.arange(300))
    assert distances.max() < 1e-12


@pytest.mark.parametrize("matcher", [*EXACT, *APPROXIMATE], ids=repr)
@pytest.mark.parametrize("m", [1, 3])
def test_fewer_keys_than_asked_for(matcher: Matcher, m: int) -> None:
    keys = noise(m, 4)
    _, labels = matcher.fit(keys).search(noise(9, 4, seed=1), 5)
    assert labels.shape[0] == 9
    assert 1 <= labels.shape[1] <= 5
    assert labels.min() >= 0
    assert labels.max() < m


def test_a_fit_is_repeatable() -> None:
    keys, queries = noise(400, 5), noise(50, 5, seed=1)
    matcher = Clustered(clusters=20, probes=2, least=0)
    first, second = (matcher.fit(keys).search(queries, 3) for _ in range(2))
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


@pytest.mark.parametrize("options", [{"clusters": 0}, {"probes": 0}])
def test_wrong_settings_say_what_is_wrong(options: dict[str, int]) -> None:
    (name,) = options
    with pytest.raises(ValueError, match=f"{name}=0 must be at least 1"):
        Clustered(**options)


@pytest.mark.parametrize("chunk", [3, 4096])
def test_minima_of_both_sides(chunk: int) -> None:
    queries, keys = noise(23, 4), noise(17, 4, seed=1)
    near, labels, used = two_sided_minima(queries, keys, chunk=chunk)
    table = brute_force(queries, keys)
    torch.testing.assert_close(near, table.amin(1))
    assert torch.equal(labels, table.argmin(1))
    torch.testing.assert_close(used, table.amin(0))


@pytest.mark.parametrize("alpha", [0.01, 1.0])
@pytest.mark.parametrize("k", [1, 4])
@pytest.mark.parametrize("chunk", [5, 2048])
def test_complete_search_by_its_formula(alpha: float, k: int, chunk: int) -> None:
    queries, keys = noise(23, 4), noise(17, 4, seed=1)
    scores, labels = complete_search(queries, keys, k, alpha=alpha, chunk=chunk)
    table = brute_force(queries, keys)
    used = table.amin(0)
    expected, order = (table / (used + alpha * used.median())).sort(dim=1)
    torch.testing.assert_close(scores, expected[:, :k])
    assert torch.equal(labels, order[:, :k])


def test_complete_search_uses_keys_that_plain_search_forgets() -> None:
    keys = torch.cat([0.02 * noise(10, 3), 1 + 0.02 * noise(10, 3, seed=1)])
    queries = 0.3 * noise(40, 3, seed=2)
    plain = Exact().fit(keys).search(queries, 1)[1].unique()
    complete = complete_search(queries, keys, 1, alpha=0.01)[1].unique()
    assert plain.max() < 10
    assert complete.max() >= 10
    nearest = complete_search(queries, keys, 1, alpha=1e9)[1]
    assert torch.equal(nearest, Exact().fit(keys).search(queries, 1)[1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_complete_search_of_equal_images_has_no_nan(dtype: torch.dtype) -> None:
    keys = noise(12, 3, dtype=dtype)
    scores, labels = complete_search(keys, keys, 1, alpha=0.02)
    assert scores.isfinite().all()
    assert torch.equal(labels[:, 0], torch.arange(12))
    flat = torch.zeros(5, 3, dtype=dtype)
    assert complete_search(flat, flat, 2, alpha=0.02)[0].isfinite().all()


def test_axes_are_orthonormal_and_span_the_leading_singular_vectors() -> None:
    spread = torch.tensor([9.0, 7, 5, 0.02, 0.02, 0.01, 0.01, 0.01], dtype=torch.float64)
    basis = torch.linalg.qr(noise(8, 8, seed=1))[0]
    sample = 3 + (noise(60, 8, seed=2) - 0.5) * spread @ basis
    axes = principal_axes(sample, 3, torch.Generator().manual_seed(0))
    torch.testing.assert_close(axes.T @ axes, torch.eye(3).double())
    leading = torch.linalg.svd(sample - sample.mean(0))[2][:3].T
    torch.testing.assert_close(axes @ axes.T, leading @ leading.T, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("m", "count"), [(1, 3), (2, 5), (50, 20)])
def test_axes_stay_orthonormal_when_the_sample_is_poor(m: int, count: int) -> None:
    axes = principal_axes(noise(m, 8), count, torch.Generator().manual_seed(0))
    assert axes.shape == (8, min(count, 8))
    torch.testing.assert_close(axes.T @ axes, torch.eye(axes.shape[1]).double())


def test_the_examples_run() -> None:
    assert doctest.testmod(matching).failed == 0
