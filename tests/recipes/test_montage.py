"""What recipes return: files, pictures of seams and patches."""

import json
from pathlib import Path

import pytest
import torch
from conftest import noise

from torchtex.image import load, read_metadata
from torchtex.recipes.montage import Montage, color_labels, draw_seams, seams_between
from torchtex.sources import copied


@pytest.fixture
def montage() -> Montage:
    where = torch.stack(torch.meshgrid(torch.arange(6), torch.arange(8), indexing="ij"), -1)
    where = torch.cat([torch.zeros(6, 8, 1, dtype=torch.long), where], -1)
    field = copied(where, ((8, 8),))
    patches = torch.zeros(6, 8, dtype=torch.long)
    patches[:, 5:] = 1
    return Montage(field.apply(noise(3, 8, 8)), field, patches, 0.5, 3, {"block": 4})


def test_a_saved_montage_holds_its_settings(montage: Montage, tmp_path: Path) -> None:
    montage.save(tmp_path / "m.png")
    about = json.loads(read_metadata(tmp_path / "m.png")["torchtex"])
    assert about["settings"] == {"block": 4}
    assert about["seed"] == 3
    assert about["patches"] == 2
    torch.testing.assert_close(
        load(tmp_path / "m.png").image, montage.texture.float(), atol=0.5 / 255 + 1e-6, rtol=0
    )


def test_maps_follow_the_sources(montage: Montage) -> None:
    assert torch.equal(montage.apply(noise(3, 8, 8)), montage.texture)
    assert torch.equal(montage.source_map[..., 1:], montage.field.positions[0, ..., 1:])


def test_seams_lie_between_patches(montage: Montage) -> None:
    seams = montage.seams
    assert bool(seams[:, 4].all())
    assert int(seams.sum()) == 6
    assert torch.equal(seams, seams_between(montage.patches))
    picture = montage.seam_picture()
    assert torch.equal(picture[:, 0, 4], torch.tensor([1.0, 0.0, 0.0]).double())
    assert draw_seams(noise(5, 6, 8), seams).shape == (3, 6, 8)


def test_patches_have_colors_of_their_own(montage: Montage) -> None:
    picture = montage.patch_picture()
    assert len(torch.unique(picture.flatten(1), dim=1).T) == 2
    assert float(picture.min()) >= 0
    assert float(picture.max()) <= 1
    assert torch.equal(color_labels(torch.tensor([[-1]])), torch.zeros(3, 1, 1))
