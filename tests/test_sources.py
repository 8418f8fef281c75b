"""Source fields: copies, blends, fractional positions, files."""

from pathlib import Path

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex.labels import LabelField, load_field
from torchtex.neighborhoods import Grid
from torchtex.sources import SourceField, copied


def positions(h: int, w: int, extent: int, exemplars: int = 1, seed: int = 0) -> Tensor:
    """Random whole positions in exemplars of extent x extent pixels."""
    generator = torch.Generator().manual_seed(seed)
    which = torch.randint(exemplars, (h, w, 1), generator=generator)
    return torch.cat([which, torch.randint(extent, (h, w, 2), generator=generator)], -1)


def test_one_layer_copies_pixels_exactly() -> None:
    where = positions(5, 7, 9, exemplars=2)
    maps = [noise(3, 9, 9), noise(3, 9, 9, seed=1)]
    made = copied(where, ((9, 9), (9, 9))).apply(maps)
    for i in range(5):
        for j in range(7):
            z, row, col = where[i, j].tolist()
            assert torch.equal(made[:, i, j], maps[z][:, row, col])


def test_layers_are_blended_by_their_weights() -> None:
    field = SourceField(
        torch.stack([positions(4, 4, 8), positions(4, 4, 8, seed=1)]),
        torch.stack([torch.full((4, 4), 3.0), torch.full((4, 4), 1.0)]),
        ((8, 8),),
    )
    image = noise(2, 8, 8)
    one, two = (copied(p, ((8, 8),)).apply(image) for p in field.positions)
    torch.testing.assert_close(field.apply(image), 0.75 * one + 0.25 * two)
    assert torch.equal(field.source_map(), field.positions[0])


def test_fractional_positions_are_read_bilinearly() -> None:
    row = torch.arange(6.0, dtype=torch.float64)[:, None]
    plane = (0.1 * row + 0.05 * row.T)[None]  # bilinear reading is exact on a plane
    where = torch.rand(3, 5, 3, generator=torch.Generator().manual_seed(0)) * 5
    where[..., 0] = 0
    made = copied(where, ((6, 6),)).apply(plane)
    torch.testing.assert_close(
        made[0], 0.1 * where[..., 1].double() + 0.05 * where[..., 2].double(), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize("fractional", [False, True])
def test_files_hold_the_whole_field(tmp_path: Path, fractional: bool) -> None:
    where = positions(6, 5, 9)
    field = copied(where.float() if fractional else where, ((9, 9),))
    field.save(tmp_path / "f.npz")
    read = load_field(tmp_path / "f.npz")
    assert isinstance(read, SourceField)
    assert torch.equal(read.positions, field.positions)
    assert read.shapes == field.shapes
    assert torch.equal(read.apply(noise(1, 9, 9)), field.apply(noise(1, 9, 9)))


def test_both_kinds_of_label_files_are_told_apart(tmp_path: Path) -> None:
    label_field = LabelField(
        Grid(8, 8, 8, 8), torch.tensor([[0, 2, 1]]), torch.ones(1), ((16, 16),)
    )
    label_field.save(tmp_path / "l.npz")
    assert isinstance(load_field(tmp_path / "l.npz"), LabelField)
    with pytest.raises(ValueError, match=r"labels=.* is not a label file"):
        SourceField.load(tmp_path / "l.npz")
    with pytest.raises(ValueError, match=r"labels=.* is not a label file"):
        load_field(tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("place", "words"),
    [((0, 9, 0), "leave their exemplar"), ((0, -1, 0), "leave"), ((1, 0, 0), "not in shapes")],
)
def test_positions_outside_are_refused(place: tuple[int, int, int], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        copied(torch.tensor([[place]]), ((9, 9),))


@pytest.mark.usefixtures("unchecked")
def test_maps_that_do_not_fit_are_refused() -> None:
    field = copied(positions(3, 3, 8), ((8, 8),))
    with pytest.raises(ValueError, match="map: 2 given for 1 exemplars"):
        field.apply([noise(1, 8, 8), noise(1, 8, 8)])
    with pytest.raises(ValueError, match="map is 8x9 and its exemplar is 8x8"):
        field.apply(noise(1, 8, 9))
    with pytest.raises(ValueError, match=r"do not fit weights"):
        SourceField(torch.zeros(1, 2, 2, 3).long(), torch.ones(1, 2, 3), ((8, 8),))
