"""Mixed exemplars, and the guides made by functions."""

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex.recipes.mix import mix, mixing, oriented, shaped
from torchtex.schedule import Level
from torchtex.synthesize import synthesize

SCHEDULE = (Level(0.5, 8, 2), Level(1.0, 8, 2))


def pair() -> list[Tensor]:
    return [stripes(32, 32), 0.3 + 0.4 * noise(3, 36, 30, seed=2)]


def ramp() -> Tensor:
    return ((torch.arange(72.0) - 24) / 24).clamp(0, 1).expand(1, 32, 72).double()


def test_pure_parts_are_pure_and_grey_ones_are_mixed() -> None:
    result = mix(pair(), ramp(), schedule=SCHEDULE, seed=1)
    which = result.source_map[..., 0]
    assert float((which[:, :24] == 0).double().mean()) > 0.98
    assert float((which[:, 48:] == 1).double().mean()) > 0.98
    assert 0.2 < float(which[:, 24:48].double().mean()) < 0.8
    assert torch.equal(result.apply(pair()).clamp(0, 1), result.texture)


def test_three_exemplars_have_a_map_each_and_the_seed_decides() -> None:
    zs = [*pair(), stripes(32, 32, seed=4).flip(1)]
    maps = torch.eye(3).double()[:, None].repeat_interleave(16, 2).expand(3, 24, 48)
    result = mix(zs, maps, schedule=SCHEDULE, seed=2)
    which = result.source_map[..., 0]
    for number in range(3):
        assert (
            float((which[:, 16 * number + 4 : 16 * number + 12] == number).double().mean()) > 0.95
        )
    assert torch.equal(mix(zs, maps, schedule=SCHEDULE, seed=2).texture, result.texture)


def test_shares_of_blobs_are_those_of_the_map() -> None:
    guide = mixing(pair(), torch.full((1, 64, 64), 0.3).double())
    assert abs(float(guide.texture[1].mean()) - 0.3) < 1e-3
    assert torch.equal(guide.texture.sum(0), torch.ones(64, 64).double())


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.2, 2.5])
def test_orientation_of_known_stripes(angle: float) -> None:
    row, col = torch.meshgrid(torch.arange(40.0), torch.arange(40.0), indexing="ij")
    # lines along (-sin t, cos t): the phase changes across them
    across = row * torch.cos(torch.tensor(angle)) + col * torch.sin(torch.tensor(angle))
    guide = oriented([torch.sin(across / 2)[None]], torch.full((8, 8), angle))
    found = guide.exemplars[0][:, 8:-8, 8:-8]
    assert float((found - guide.texture[:, :1, :1]).abs().max()) < 0.1


def test_an_orientation_is_followed() -> None:
    flat = 0.5 + 0.4 * torch.sin(torch.arange(40.0) * 0.8)[None, :, None].expand(1, 40, 40)
    both = [flat, flat.transpose(1, 2).contiguous()]
    angles = torch.zeros(32, 64)
    angles[:, 32:] = torch.pi / 2
    guide = oriented(both, angles, weight=2.0)
    which = synthesize(both, (32, 64), guides=[guide], schedule=SCHEDULE).source_map[..., 0]
    assert float((which[:, :26] == 0).double().mean()) > 0.95
    assert float((which[:, 38:] == 1).double().mean()) > 0.95


def test_a_shape_is_followed() -> None:
    inside = (torch.arange(40) < 20).expand(40, 40)
    image = torch.where(inside, 0.8, 0.2)[None] + 0.05 * noise(1, 40, 40, dtype=torch.float32)
    wanted = (torch.arange(48) < 15)[:, None].expand(48, 48) | (torch.arange(48) < 15)
    guide = shaped([inside], wanted, reach=6)
    texture = synthesize(image, (48, 48), guides=[guide], schedule=SCHEDULE).texture[0]
    assert float(((texture > 0.5) == wanted).double().mean()) > 0.93


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        (torch.full((1, 8, 8), 1.5), "weights lie in 1.5..1.5"),
        (torch.ones(3, 8, 8), "3 maps given for 2 exemplars"),
        (torch.zeros(2, 8, 8), "0 in all maps"),
    ],
)
def test_bad_maps(weights: Tensor, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        mix(pair(), weights.double())


def test_bad_options() -> None:
    with pytest.raises(ValueError, match="give at least two"):
        mix(pair()[:1], ramp())
    with pytest.raises(ValueError, match="seed=-1"):
        mix(pair(), ramp(), seed=-1)
    with pytest.raises(ValueError, match="weight=-1"):
        mix(pair(), ramp(), weight=-1.0)
    with pytest.raises(ValueError, match="grain=-1"):
        mixing(pair(), ramp(), grain=-1.0)
    with pytest.raises(ValueError, match="sigma=0"):
        oriented(pair(), torch.zeros(8, 8), sigma=0.0)
    with pytest.raises(ValueError, match="reach=0"):
        shaped([], torch.ones(8, 8, dtype=torch.bool), reach=0)


def test_previews_have_the_size_of_the_texture() -> None:
    shapes = set()
    ramp = torch.linspace(0, 1, 40).expand(1, 40, 40)
    mix(
        [stripes(32, 32), noise(3, 32, 32)],
        ramp,
        on_step=lambda p: shapes.add(p.half.texture.shape),
    )
    assert shapes == {(3, 40, 40)}
