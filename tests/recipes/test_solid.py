"""Solids: slices like the exemplars, voxels that are their pixels, axes, maps, going on."""

import pytest
import torch
from conftest import noise, spots, stripes

from torchtex.features import Pixels, Wavelets
from torchtex.recipes.slice_models import slice_model
from torchtex.recipes.slice_votes import match, prices_of, snapped
from torchtex.recipes.solid import solid, solid_schedule
from torchtex.recipes.solid_parts import check_solid, sides_of
from torchtex.recipes.solid_places import finer_places, places_of, table_of
from torchtex.recipes.solid_result import Solid, SolidCheckpoint, SolidStep
from torchtex.schedule import Level
from torchtex.volumes.histograms import earth_mover
from torchtex.volumes.slices import groups, slices_of

SHORT = (Level(0.5, 8, 3, 4), Level(1.0, 8, 2, 4))


def small(seed: int = 0, **options: object) -> Solid:
    """A little solid of stripes."""
    return solid(stripes(32, 32), (16, 17, 18), schedule=SHORT, seed=seed, **options)  # type: ignore[arg-type]


def test_every_voxel_is_an_exemplar_pixel_and_maps_follow() -> None:
    made = small()
    assert made.volume.shape == (3, 16, 17, 18)
    assert made.volume.dtype == torch.float64
    assert torch.equal(made.apply(stripes(32, 32)), made.volume)
    row = torch.arange(32.0)[None, :, None].expand(1, 32, 32)
    assert torch.equal(made.apply(row)[0].long(), made.sources[..., 1].long())
    with pytest.raises(ValueError, match="size of the exemplar"):
        made.apply(torch.zeros(1, 31, 32))


def test_same_seed_same_bits_for_any_threads() -> None:
    first = small(3)
    torch.set_num_threads(2)
    again = small(3)
    assert torch.equal(first.volume, again.volume)
    assert first.energies == again.energies
    assert not torch.equal(first.volume, small(4).volume)


def test_energy_falls_and_colours_stay() -> None:
    plan = (Level(0.5, 8, 5, 2), Level(1.0, 8, 4, 4))
    made = solid(stripes(48, 48), (24, 24, 24), schedule=plan)
    for trace in made.traces:
        assert trace.energies[-1] < trace.energies[0]
    assert float(earth_mover(made.volume, stripes(48, 48)).max()) < 0.05


def test_histograms_hold_a_rare_motif() -> None:
    # a single ring: slices of spheres hold fewer of its colours than the picture
    plan = (Level(0.5, 8, 5, 2), Level(1.0, 8, 4, 4))
    apart = [
        float(earth_mover(solid(spots(), (24, 24, 24), schedule=plan, histogram=h).volume, spots()))
        for h in (0.0, 5.0)
    ]
    assert apart[1] < 0.75 * apart[0]


def test_a_volume_tiles() -> None:
    made = small().volume
    for dim in (1, 2, 3):
        steps = (made - made.roll(1, dim)).abs().movedim(dim, 0).flatten(1).mean(1)
        assert float(steps[0]) < 1.5 * float(steps.mean())


def test_axes_follow_their_own_exemplars() -> None:
    upright = stripes(32, 32, 1)
    flat = torch.full((1, 32, 32), 0.5, dtype=torch.float64) + 0.01 * noise(1, 32, 32)
    made = solid([upright, None, upright], (16, 16, 16), schedule=SHORT)
    assert made.settings["axes"] == [0, None, 0]
    assert len(made.shapes) == 1
    both = solid([upright, flat], (16, 16, 16), schedule=SHORT)
    assert both.settings["axes"] == [0, 1, 0]
    assert set(both.sources[..., 0].unique().tolist()) <= {0, 1}
    assert torch.equal(both.apply([upright, flat]), both.volume)


def test_rows_of_side_views_lie_along_the_rows() -> None:
    ramp = torch.linspace(0, 1, 32, dtype=torch.float64)[None, :, None].expand(1, 32, 32)
    lines = (ramp * 8 % 1 > 0.5).double()  # lie flat: the rows differ, the columns are alike
    made = solid([lines, None, lines], (16, 16, 16), schedule=SHORT).volume
    along = (made - made.roll(1, 2)).abs().mean()  # down the rows
    across = max((made - made.roll(1, dim)).abs().mean() for dim in (1, 3))
    assert float(along) > 2 * float(across)


def test_maps_steer_and_are_not_in_the_result() -> None:
    exemplar, height = stripes(32, 32), noise(1, 32, 32, seed=5)
    made = solid(exemplar, (16, 16, 16), maps=height, schedule=SHORT)
    plain = solid(exemplar, (16, 16, 16), schedule=SHORT)
    assert made.volume.shape == plain.volume.shape
    assert not torch.equal(made.volume, plain.volume)
    with pytest.raises(ValueError, match="map"):
        solid(exemplar, (16, 16, 16), maps=noise(1, 8, 8), schedule=SHORT)


def test_a_run_goes_on_with_the_same_bits(tmp_path: object) -> None:
    kept: list[SolidCheckpoint] = []
    whole = small(on_level=kept.append)
    path = f"{tmp_path}/state.npz"
    kept[0].save(path)
    again = small(resume=SolidCheckpoint.load(path))
    assert torch.equal(again.volume, whole.volume)
    assert again.energies == whole.energies
    with pytest.raises(ValueError, match=r"checkpoint=.*state.npz' is of a run with seed=0"):
        small(seed=1, resume=SolidCheckpoint.load(path))
    with pytest.raises(ValueError, match="resume: the checkpoint is of a run with seed=0"):
        small(seed=1, resume=kept[0])
    with open(path, "wb") as file:
        file.write(b"other")
    with pytest.raises(ValueError, match="not a checkpoint"):
        SolidCheckpoint.load(path)


def test_masked_pixels_are_never_used() -> None:
    exemplar, mask = stripes(48, 48), torch.ones(48, 48, dtype=torch.bool)
    mask[:, 30:] = False
    mask[:6, :6] = False
    exemplar[:, ~mask] = float("nan")
    height = noise(1, 48, 48, seed=5)
    for options in ({}, {"maps": height}):
        made = solid(exemplar, (16, 16, 16), masks=mask, schedule=SHORT, **options)
        row, col = made.sources[..., 1].long(), made.sources[..., 2].long()
        assert bool(mask[row, col].all())
        assert bool(made.volume.isfinite().all())
    other = stripes(48, 48).flip(1)
    both = solid([other, exemplar], (16, 16, 16), masks=[None, mask], schedule=SHORT)
    which, row, col = both.sources.long().unbind(-1)
    assert bool(mask[row[which == 1], col[which == 1]].all())
    with pytest.raises(ValueError, match="mask: no window of 8"):
        solid(other, (16, 16, 16), masks=torch.eye(48, dtype=torch.bool), schedule=SHORT)
    with pytest.raises(ValueError, match="mask: give one for each"):
        solid([other, None, other], (16, 16, 16), masks=[mask, mask, mask], schedule=SHORT)
    with pytest.raises(ValueError, match="mask is 8x8"):
        solid(other, (16, 16, 16), masks=mask[:8, 10:18], schedule=SHORT)


def test_wavelets_are_compared_and_are_recorded() -> None:
    made = small(feature=Wavelets("haar"))
    assert not torch.equal(made.volume, small().volume)
    assert torch.equal(made.apply(stripes(32, 32)), made.volume)
    assert "haar" in made.settings["feature"]
    with pytest.raises(ValueError, match="stationary"):
        small(feature=Wavelets(mode="window"))


def test_a_block_fills_a_larger_volume() -> None:
    made = small()
    large = made.tiled((32, 20, 5))
    assert torch.equal(large[:, 16:, :17], made.volume[:, :, :, :5])
    assert torch.equal(large[:, :16, 17:], made.volume[:, :, :3, :5])


def test_it_knows_no_faces() -> None:
    # a face is a plane like others: a step across it is among those inside, over many volumes
    shares = []
    for seed in range(6):
        made = solid(noise(1, 24, 24), (12, 12, 12), schedule=(Level(1.0, 6, 3, 3),), seed=seed)
        for dim in (1, 2, 3):
            apart = made.volume - made.volume.roll(1, dim)
            steps = apart.abs().movedim(dim, 0).flatten(1).mean(1)
            shares.append(float((steps[1:] > steps[0]).double().mean()))
    assert 0.25 < sum(shares) / len(shares) < 0.75


def test_progress_rises_to_one_and_a_run_can_be_stopped() -> None:
    seen: list[SolidStep] = []
    small(on_step=seen.append)
    done = [step.done for step in seen]
    assert done == sorted(done)
    assert done[-1] == pytest.approx(1)
    assert seen[-1].texture.shape == (3, 17, 18)

    def stop(step: SolidStep) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        small(on_step=stop)


def test_slices_of_the_exemplar_itself_match_themselves() -> None:
    exemplar = noise(1, 16, 16)
    generator = torch.Generator().manual_seed(0)
    model = slice_model(exemplar, None, 0, 8, torch.ones(1).double(), Pixels(), 64, generator)
    volume = exemplar[0][None, :, :, None].expand(8, 16, 16, 1).contiguous()
    across = groups((8, 16, 16), 0, 8, 8, torch.tensor([0, 0]))[:1]
    pairs = [(model, g) for g in across]
    prices = prices_of(volume, pairs, 0.0)
    matches, energy, _ = match(volume, pairs, prices, r=0.8)
    assert matches[0].places[0].flatten().tolist() == [0, 8, 128, 136]
    table = table_of([exemplar])
    pixel, axis, fields = snapped(matches, table, volume, torch.ones(1).double())
    assert torch.equal(pixel[0].flatten(), torch.arange(256))
    assert not bool(axis.any())
    assert energy > 0
    again, same, _ = match(volume, pairs, prices, {0: fields[0].clone()}, r=0.8)  # proposed alone
    assert torch.equal(again[0].places, matches[0].places)
    assert same == energy


def test_places_of_a_finer_level() -> None:
    pixel = torch.arange(16).view(1, 4, 4).expand(4, 4, 4)
    axis = torch.zeros_like(pixel)
    fine = finer_places(pixel, axis, [(4, 4)], [(8, 8)], (8, 8, 8))
    assert torch.equal(fine[5].flatten(), torch.arange(64))
    assert places_of(fine, [(8, 8)])[0, 7, 6].tolist() == [0, 7, 6]


def test_slices_look_like_the_exemplar() -> None:
    from torchtex import metrics

    exemplar = stripes(48, 48, 1)
    generator = torch.Generator().manual_seed(0)
    made = solid([exemplar, None, exemplar], (24, 24, 24), schedule=SHORT)
    for axis in (0, 2):
        cut = slices_of(made.volume, axis)[7].contiguous()
        mixed = cut.flatten(1)[:, torch.randperm(576, generator=generator)].view_as(cut)
        assert metrics.nn(cut, exemplar) < 0.4 * metrics.nn(mixed, exemplar)


@pytest.mark.parametrize(
    ("words", "exemplars", "size", "options"),
    [
        ("channels", [noise(3, 32, 32), noise(1, 32, 32)], (16, 16, 16), {}),
        ("4 given", [noise(1, 32, 32)] * 4, (16, 16, 16), {}),
        ("none given", [None, None, None], (16, 16, 16), {}),
        ("at least 6x6x6", noise(1, 32, 32), (16, 4, 16), {}),
        ("at least 12 pixels", noise(1, 11, 32), (16, 16, 16), {}),
        ("GiB", noise(1, 32, 32), (60000, 60000, 60000), {}),
        ("r=0", noise(1, 32, 32), (16, 16, 16), {"r": 0.0}),
        ("completeness=-1", noise(1, 32, 32), (16, 16, 16), {"completeness": -1.0}),
        ("seed=-1", noise(1, 32, 32), (16, 16, 16), {"seed": -1}),
        ("scale=1", noise(1, 32, 32), (16, 16, 16), {"schedule": (Level(0.5, 8, 1),)}),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_input_gets_a_sentence(
    words: str, exemplars: object, size: tuple[int, int, int], options: dict[str, object]
) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        solid(exemplars, size, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_parts() -> None:
    one = noise(1, 16, 16)
    assert sides_of(one).axes == (0, 0, 0)
    assert sides_of([one, 1 - one]).axes == (0, 1, 0)
    check_solid((8, 8, 8), 3, 8, 0)
    assert [level.steps for level in solid_schedule(2)] == [2, 2, 2, 2]
    made = small()
    assert made.report()["levels"][0]["scale"] == 0.5
    assert made.sheet().shape[0] == 3
