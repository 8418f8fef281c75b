"""The label field: identity on a noise exemplar, exact copies, other maps, files."""

import doctest
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex import labels as labels_module
from torchtex.labels import LabelField
from torchtex.model import Search, TextureModel, exact_search, fast_search, texture_model
from torchtex.neighborhoods import Grid, falloff

SEARCHES = [exact_search(), fast_search()]


def field_of(model: TextureModel, labels: Tensor, *exemplars: Tensor) -> LabelField:
    shapes = tuple((z.shape[1], z.shape[2]) for z in exemplars)
    weights = torch.ones(len(labels), dtype=torch.float64)
    return LabelField(model.grid, model.space.positions[labels], weights, shapes)


@pytest.mark.parametrize("search", SEARCHES, ids=repr)
@pytest.mark.parametrize("size", [4, 7])
def test_noise_matches_itself_with_cost_0_and_identity_labels(search: Search, size: int) -> None:
    z = noise(3, 30, 27)
    model = texture_model([z], Grid(30, 27, size, 2), search=search)
    labels = model.match(z)
    field = field_of(model, labels, z)
    assert field.offsets.abs().max() == 0
    assert model.energy(labels).distances(z).max() < 1e-20
    torch.testing.assert_close(field.apply(z), z)


@pytest.mark.parametrize("search", SEARCHES, ids=repr)
def test_a_crop_of_noise_has_a_constant_offset_field(search: Search) -> None:
    z = noise(2, 30, 27)
    crop = z[:, 5:25, 9:26].contiguous()
    model = texture_model([z], Grid(20, 17, 6, 3), search=search)
    field = field_of(model, model.match(crop), z)
    assert field.offsets.shape == (*model.grid.shape, 2)
    assert torch.equal(field.offsets, torch.tensor([5, 9]).expand_as(field.offsets))
    torch.testing.assert_close(field.apply(z), crop)
    source = field.source_map()
    rows, cols = torch.meshgrid(torch.arange(20) + 5, torch.arange(17) + 9, indexing="ij")
    assert torch.equal(source, torch.stack([torch.zeros_like(rows), rows, cols], -1))


@pytest.mark.parametrize("periodic", [False, True])
def test_labels_without_overlap_copy_the_matched_patches_exactly(periodic: bool) -> None:
    z = noise(3, 20, 23)
    grid = Grid(16, 24, 8, 8, periodic)
    places = torch.tensor([[0, 0, 0], [0, 12, 15], [0, 3, 7], [0, 5, 1], [0, 8, 8], [0, 12, 0]])
    weights = noise(6, seed=1) + 0.1
    field = LabelField(grid, places, weights, ((20, 23),))
    texture = field.apply(z)
    for (row, col), (_, y, x) in zip(grid.sites.tolist(), places.tolist(), strict=True):
        torch.testing.assert_close(
            texture[:, row : row + 8, col : col + 8], z[:, y : y + 8, x : x + 8],
            rtol=1e-14, atol=0,
        )  # fmt: skip
    source = field.source_map()
    assert torch.equal(source[0, 0], places[0])
    torch.testing.assert_close(z[:, source[..., 1], source[..., 2]], texture, rtol=1e-14, atol=0)


def test_overlaps_are_weighted_means() -> None:
    z = torch.arange(10, dtype=torch.float64).view(1, 1, 10).expand(1, 4, 10).contiguous()
    grid = Grid(4, 6, 4, 2)
    places, weights = torch.tensor([[0, 0, 0], [0, 0, 5]]), torch.tensor([1.0, 3.0]).double()
    field = LabelField(grid, places, weights, ((4, 10),))
    texture = field.apply(z)
    f = falloff(4)[0]
    expected = (f[2] * 2 + 3 * f[0] * 5) / (f[2] + 3 * f[0])
    torch.testing.assert_close(texture[0, 0, 2], expected)
    assert field.source_map()[0, :, 2].tolist() == [0, 1, 5, 6, 7, 8]


def test_other_maps_follow_the_same_labels() -> None:
    z = noise(3, 20, 20)
    model = texture_model([z], Grid(18, 18, 6, 3))
    field = field_of(model, model.match(noise(3, 18, 18, seed=1)), z)
    height = z.mean(0, keepdim=True)
    torch.testing.assert_close(field.apply(height), field.apply(z).mean(0, keepdim=True))
    five = torch.cat([z, z[:2] ** 2])
    assert field.apply(five).shape == (5, 18, 18)
    assert field.apply(five.float()).dtype == torch.float32
    torch.testing.assert_close(field.apply(100 * z - 7), 100 * field.apply(z) - 7)
    torch.testing.assert_close(field.apply([z]), field.apply(z))


def test_several_exemplars_are_rendered_from_their_own_maps() -> None:
    first, second = noise(1, 16, 20), noise(1, 25, 14, seed=1)
    grid = Grid(12, 24, 4, 4)
    wanted = torch.cat([first[:, 2:14, 1:13], second[:, 7:19, 2:14]], 2)
    model = texture_model([first, second], grid, search=exact_search())
    field = field_of(model, model.match(wanted), first, second)
    source = field.source_map()[..., 0]
    assert (source[:, :12] == 0).all()
    assert (source[:, 12:] == 1).all()
    torch.testing.assert_close(field.apply([first, second]), wanted)


def test_no_label_touches_masked_pixels() -> None:
    z = stripes(24, 24, 1)
    mask = noise(24, 24) > 0.02
    model = texture_model([z], Grid(20, 20, 4, 2), masks=[mask], search=fast_search())
    field = field_of(model, model.match(noise(1, 20, 20)), z)
    assert (field.apply((~mask).double()[None]) == 0).all()


@pytest.mark.parametrize("periodic", [False, True])
def test_a_file_brings_everything_back(tmp_path: Path, periodic: bool) -> None:
    grid = Grid(18, 17, 6, 3, periodic)
    places = torch.randint(0, 10, (len(grid), 3), generator=torch.Generator().manual_seed(0))
    places[:, 0] = places[:, 0] % 2
    field = LabelField(grid, places, noise(len(grid)), ((16, 16), (16, 17)))
    field.save(tmp_path / "labels.npz")
    back = LabelField.load(tmp_path / "labels.npz")
    assert back.grid == grid
    assert back.shapes == field.shapes
    assert torch.equal(back.positions, field.positions)
    assert torch.equal(back.weights, field.weights)
    maps = [noise(2, 16, 16), noise(2, 16, 17)]
    assert torch.equal(back.apply(maps), field.apply(maps))
    assert [path.name for path in tmp_path.iterdir()] == ["labels.npz"]


def test_what_is_no_label_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is not a label file"):
        LabelField.load(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(ValueError, match="is not a label file"):
        LabelField.load(tmp_path / "text.npz")
    (tmp_path / "empty.npz").write_bytes(b"")
    with pytest.raises(ValueError, match="is not a label file"):
        LabelField.load(tmp_path / "empty.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="is not a label file"):
        LabelField.load(tmp_path / "other.npz")
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(ValueError, match="is not a label file"):
        LabelField.load(tmp_path / "array.npy")
    short = LabelField(Grid(16, 8, 8, 8), torch.zeros(1, 3).long(), torch.ones(1), ((9, 9),))
    short.save(tmp_path / "short.npz")
    with pytest.raises(ValueError, match="do not fit its grid"):
        LabelField.load(tmp_path / "short.npz")
    LabelField(Grid(8, 8, 8, 8), torch.zeros(1, 3).long(), torch.ones(1), ((9, 9),)).save(
        tmp_path / "good.npz"
    )
    whole = (tmp_path / "good.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="is not a label file"):
        LabelField.load(tmp_path / "cut.npz")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("maps", "message"),
    [
        (lambda: noise(1, 8, 9), "map is 8x9 and its exemplar is 9x9"),
        (lambda: [noise(1, 9, 9)] * 2, "map: 2 given for 1 exemplars"),
        (lambda: noise(9, 9), "map has shape"),
        (lambda: noise(1, 9, 9) / 0, "map holds NaN"),
    ],
)
def test_wrong_maps_say_what_is_wrong(maps: Callable[[], Tensor], message: str) -> None:
    field = LabelField(Grid(8, 8, 8, 8), torch.zeros(1, 3).long(), torch.ones(1), ((9, 9),))
    with pytest.raises(ValueError, match=message):
        field.apply(maps())


def test_the_examples_run() -> None:
    assert doctest.testmod(labels_module).failed == 0


@pytest.mark.parametrize("position", [[1, 0, 0], [0, 9, 0], [0, 0, -1]])
def test_a_label_file_that_leaves_its_exemplar_is_refused(
    tmp_path: Path, position: list[int]
) -> None:
    field = LabelField(Grid(8, 8, 8, 8), torch.tensor([position]), torch.ones(1), ((16, 16),))
    field.save(tmp_path / "labels.npz")
    with pytest.raises(ValueError, match=r"labels=.*exemplar"):
        LabelField.load(tmp_path / "labels.npz")
