"""Histograms: the earth mover's distance, and weights that draw a volume to its exemplar."""

import numpy as np
import pytest
import torch
from conftest import noise

from torchtex.volumes.histograms import bins_of, earth_mover, excess


def test_earth_mover_of_shifted_and_shuffled_values() -> None:
    a = noise(2, 40, 40)
    shuffled = a.flatten(1)[:, torch.randperm(1600, generator=torch.Generator().manual_seed(1))]
    assert torch.equal(earth_mover(a, shuffled), torch.zeros(2, dtype=a.dtype))
    assert torch.allclose(earth_mover(a, a + 0.1), torch.full((2,), 0.1, dtype=a.dtype))
    assert torch.allclose(
        earth_mover(a, a.repeat(1, 2, 1)[:, None]), torch.zeros(2).double(), atol=1e-3
    )


def test_earth_mover_equals_that_of_scipy() -> None:
    stats = pytest.importorskip("scipy.stats", reason="scipy is not installed")
    a, b = noise(1, 30, 30).square(), noise(1, 10, 10, 10, seed=2)
    wanted = stats.wasserstein_distance(np.asarray(a.flatten()), np.asarray(b.flatten()))
    assert abs(float(earth_mover(a, b)[0]) - wanted) < 2e-3


def test_bins_hold_the_ends() -> None:
    assert bins_of(torch.tensor([[-0.5, 0.0, 0.5, 1.0, 2.0]]), 4).tolist() == [[0, 0, 2, 3, 3]]


def test_only_what_is_too_frequent_is_in_excess() -> None:
    exemplar = torch.tensor([[0.1, 0.1, 0.9, 0.9]])
    assert excess(exemplar, exemplar).tolist() == [0.0] * 4
    found = excess(exemplar, torch.tensor([[0.1, 0.1, 0.1, 0.9]]))
    assert torch.allclose(found, torch.tensor([0.5, 0.5, 0.0, 0.0]))
    unknown = excess(exemplar, torch.full((1, 4), 0.5))  # a value that no exemplar pixel has
    assert unknown.tolist() == [0.0] * 4
