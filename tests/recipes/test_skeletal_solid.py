"""Skeletal solids: detail copied in three directions, refined, as good as it says."""

from dataclasses import replace

import pytest
import torch
from conftest import noise, stripes

from torchtex.features import Wavelets
from torchtex.recipes.skeletal_solid import _band, _mixed, _trimmed, skeletal_solid
from torchtex.recipes.solid_parts import sides_of
from torchtex.recipes.solid_places import table_of
from torchtex.recipes.solid_plan import Solving
from torchtex.recipes.solid_result import SolidCheckpoint, SolidStep
from torchtex.recipes.solid_run import Run
from torchtex.schedule import Level


def test_refined_voxels_are_exemplar_pixels() -> None:
    exemplar = stripes(33, 35)
    made = skeletal_solid(exemplar, (17, 16, 18))
    assert made.volume.shape == (3, 17, 16, 18)
    assert torch.equal(made.apply(exemplar), made.volume)
    assert made.settings["method"] == "skeletal"
    assert made.settings["unused"] == [[1, 1]]
    again = skeletal_solid(exemplar, (17, 16, 18))
    assert torch.equal(again.volume, made.volume)


def test_without_refinement_it_is_the_mean_of_the_paper() -> None:
    exemplar = stripes(32, 32)
    made = skeletal_solid(exemplar, (16, 16, 16), refine=0)
    assert made.sources.shape == (16, 16, 16, 3)
    finer = skeletal_solid(exemplar, (16, 16, 16), refine=2)
    steps = [(x - x.roll(1, 3)).abs().mean() for x in (made.volume, finer.volume)]
    assert steps[0] < steps[1]


def test_a_coarse_copy_of_the_exemplar_grows_into_its_copy() -> None:
    exemplar = noise(1, 32, 32)
    sides = _trimmed(sides_of([exemplar, None, None]), 2)
    settings: dict[str, object] = {}
    coarse = Run(_band(sides, 1), (16, 16, 16), [Level(1.0, 8, 1, 4)], Solving(), 0, settings)
    fine = Run(sides, (32, 32, 32), [Level(1.0, 8, 1, 4)], Solving(), 0, settings)
    generator = torch.Generator().manual_seed(0)
    # every slice across the depth is the coarse exemplar, moved so that no window of it wraps
    pixel = torch.arange(256).view(1, 16, 16).expand(16, 16, 16)
    state = SolidCheckpoint(0, settings, generator.get_state(), (), pixel, torch.zeros_like(pixel))
    mixed, fields = _mixed(coarse, fine, state, generator)
    inner = slice(14, 18)
    wanted = table_of([exemplar]).view(32, 32)
    gap = (mixed[..., 0] - wanted).abs()[:, inner, inner]
    assert float(gap.median()) < 1e-9
    assert list(fields) == [0]
    assert int(fields[0].max()) < 1024


def test_masks_and_wavelets() -> None:
    exemplar, mask = stripes(48, 48), torch.ones(48, 48, dtype=torch.bool)
    mask[33:] = False
    for refine in (0, 1):
        made = skeletal_solid(
            exemplar, (16, 16, 16), masks=mask, feature=Wavelets(levels=1), refine=refine
        )
        row, col = made.sources[..., 1].long(), made.sources[..., 2].long()
        assert bool(mask[row, col].all())


def test_coarse_band_is_the_mean_of_blocks() -> None:
    sides = _band(sides_of(noise(2, 16, 24)), 2)
    wanted = torch.nn.functional.avg_pool2d(noise(2, 16, 24), 4)
    assert torch.allclose(sides.exemplars[0], wanted)
    assert replace(sides, axes=(0, None, 0)).shapes == ((4, 6),)


def test_a_run_goes_on_with_the_same_bits_and_tells_how_far_it_is() -> None:
    kept: list[SolidCheckpoint] = []
    seen: list[SolidStep] = []
    whole = skeletal_solid(stripes(64, 64), (32, 32, 32), on_level=kept.append, on_step=seen.append)
    again = skeletal_solid(stripes(64, 64), (32, 32, 32), resume=kept[0])
    assert torch.equal(again.volume, whole.volume)
    done = [step.done for step in seen]
    assert done == sorted(done)
    assert done[-1] == pytest.approx(1)
    with pytest.raises(ValueError, match="refine"):
        skeletal_solid(stripes(64, 64), (32, 32, 32), refine=1, resume=kept[0])


@pytest.mark.parametrize(
    ("words", "side", "size", "options"),
    [
        ("octaves=4", 32, 16, {"octaves": 4}),
        ("refine=-1", 32, 16, {"refine": -1}),
        (
            "octaves=2 is too many for an exemplar of 33x33, which must be at least 64 pixels a "
            "side; choose fewer octaves or a larger exemplar",
            33,
            32,
            {"octaves": 2},
        ),
        ("31x31, which must be at least 32 pixels a side; choose a larger", 31, 16, {}),
        ("at least 16x16x16", 32, 12, {}),
    ],
)
def test_bad_input_gets_a_sentence(
    words: str, side: int, size: int, options: dict[str, int]
) -> None:
    with pytest.raises(ValueError, match=words):
        skeletal_solid(noise(1, side, side), (size, size, size), **options)


def test_masks_that_are_too_narrow_for_the_coarse_scale() -> None:
    mask = torch.zeros(64, 64, dtype=torch.bool)
    mask[:24, :24] = True
    words = "octaves=2 is too many for the masks, into one of which no window of 32 pixels fits"
    with pytest.raises(ValueError, match=words):
        skeletal_solid(noise(1, 64, 64), (32, 32, 32), octaves=2, masks=mask)
