"""Layers: two ways find what is there, scribbles and masks override, bad input is refused."""

import builtins
import sys
from typing import Any

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex.layers.segment import METHODS, Method, segment


def disks(channels: int = 3, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A picture of dark and light disks on mid-grey, with grain, and what each pixel is."""
    row, col = torch.arange(60.0)[:, None], torch.arange(64.0)
    truth = torch.zeros(60, 64, dtype=torch.long)
    for label, y, x, radius in ((1, 14, 14, 8), (1, 44, 20, 9), (2, 20, 46, 8), (2, 46, 50, 7)):
        truth[(row - y) ** 2 + (col - x) ** 2 <= radius**2] = label
    level = torch.tensor([0.5, 0.15, 0.85], dtype=torch.float64)[truth]
    return (level + 0.05 * (noise(channels, 60, 64, seed=seed) - 0.5)).clamp(0, 1), truth


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_both_methods_find_the_disks_and_the_ground(method: Method, channels: int) -> None:
    image, truth = disks(channels)
    made = segment(image, 3, method=method)
    assert made.count == 3
    assert float((made.mask(0) == (truth == 0)).double().mean()) > 0.93
    found = [int(truth[made.mask(layer)].mode().values) for layer in range(3)]
    assert sorted(found) == [0, 1, 2]
    for layer in (1, 2):
        mask = made.mask(layer) & (truth > 0)
        assert float((truth[mask] == found[layer]).double().mean()) > 0.97
        assert len(made.children_of(layer)) == 2
    again = segment(image, 3, method=method)
    assert torch.equal(made.labels, again.labels)
    assert torch.equal(made.children, again.children)


def test_children_are_connected_and_parts_of_one_layer() -> None:
    image, _ = disks(seed=2)
    made = segment(image, 2)
    assert sum(len(made.children_of(layer)) for layer in range(2)) == int(made.children.max()) + 1
    for child in range(int(made.children.max()) + 1):
        assert len(made.labels[made.children == child].unique()) == 1
    picture = made.picture(image, 1)
    assert picture.shape == (4, 60, 64)
    assert torch.equal(picture[3] > 0, made.mask(1))


def test_small_pieces_join_what_is_around_them() -> None:
    image, _ = disks()
    image[:, 30, 30:33] = 0.0
    made = segment(image, 3, method="meanshift", smooth=0.0, smallest=30)
    assert all(int((made.children == n).sum()) >= 30 for n in made.children.unique())
    assert int(made.labels[30, 31]) == 0


def test_scribbles_name_the_layers() -> None:
    image, truth = disks()
    scribbles = torch.full_like(truth, -1)
    scribbles[12:16, 12:16] = 0  # a dark disk
    scribbles[30, 5:60] = 1  # the ground
    scribbles[20, 44:48] = 0  # a light disk in the layer of the dark one
    made = segment(image, scribbles=scribbles)
    assert made.count == 2
    assert float((made.mask(0) == (truth > 0)).double().mean()) > 0.93
    assert bool((made.labels[scribbles >= 0] == scribbles[scribbles >= 0]).all())
    full = segment(image, scribbles=truth)  # everywhere: they are the layers
    assert torch.equal(full.labels, truth)


def test_masks_name_the_layers_and_the_rest_is_one_more() -> None:
    image, truth = disks()
    made = segment(image, masks=[truth == 1, truth == 2])
    assert torch.equal(made.labels, torch.where(truth == 0, 2, truth - 1))


def test_bad_input_is_refused() -> None:
    image, truth = disks()
    nothing = torch.full_like(truth, -1)
    for options, words in (
        ({"layers": 1}, "layers=1 must lie in 2..64"),
        ({"layers": 65}, "layers=65"),
        ({"smooth": -1.0}, "smooth=-1.0"),
        ({"smallest": 0}, "smallest=0"),
        ({"scribbles": nothing}, "name 0 layer"),
        ({"scribbles": truth * 0}, "name 1 layer"),
        ({"scribbles": truth * 2}, "leave some out"),
        ({"scribbles": truth[1:]}, "scribbles are 59x64"),
        ({"masks": [truth >= 0]}, "one layer only"),
        ({"masks": [truth > 4, truth > 0]}, "mask of layer 1 is empty"),
        ({"masks": [truth[1:] > 0]}, "mask of layer 1 is 59x64"),
    ):
        with pytest.raises(ValueError, match=words):
            segment(image, **options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="layers=3: only"):
        segment(torch.full((3, 20, 20), 0.5), 3)
    with pytest.raises(ValueError, match="layers=3: only"):
        segment(torch.full((3, 20, 20), 0.5), 3, method="meanshift")


def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def missing(name: str, *given: Any, **options: Any) -> Any:
        if name.startswith(("skimage", "sklearn")):
            raise ImportError(name)
        return real(name, *given, **options)

    for name in [name for name in sys.modules if name.split(".")[0] in ("skimage", "sklearn")]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ImportError, match=r"torchtex\[design\]"):
        segment(disks()[0], 3)
