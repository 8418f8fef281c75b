"""Skeletal synthesis: blocks copied whole, blends, seams that cost less, odd sizes, masks."""

import re
from pathlib import Path

import pytest
import torch
from conftest import noise, stripes

from torchtex import metrics
from torchtex.bands import BandField, band_field, block_pixels
from torchtex.features import Wavelets
from torchtex.inputs import usable_exemplars
from torchtex.labels import load_field
from torchtex.recipes.block_seams import block_seams
from torchtex.recipes.skeleton import refine, skeleton
from torchtex.recipes.skeleton_blocks import BlockShape
from torchtex.schedule import Level
from torchtex.sources import SourceField
from torchtex.wavelets import blocks_at, decompose, every_shift, reach, reconstruct

QUICK = (Level(1.0, 6, 2),)


@pytest.mark.parametrize(("wavelet", "levels"), [("haar", 3), ("db2", 2), ("db4", 1)])
def test_every_shift_holds_the_decomposition_of_each(wavelet: str, levels: int) -> None:
    image, side = noise(2, 64, 72), 2**levels
    bands = every_shift(image, wavelet, levels)
    rows, cols = 1 % side, 3 % side
    whole = decompose(image.roll((-rows, -cols), (1, 2)), wavelet, levels)
    inner = max(reach(wavelet, levels)) // side + 1  # away from the border, where they differ
    window = (slice(None), slice(inner, -inner - 1), slice(inner, -inner - 1))
    mine = bands.approximation[:, rows::side, cols::side]
    assert torch.allclose(
        mine[:, : whole.approximation.shape[1]][window], whole.approximation[window]
    )
    places = torch.zeros(64 // side - 1, 72 // side - 1, 3, dtype=torch.long)
    places[..., 1] = (rows + side * torch.arange(64 // side - 1))[:, None]
    places[..., 2] = cols + side * torch.arange(72 // side - 1)
    made = blocks_at([bands], places)
    for ours, theirs in zip(made.details, whole.details, strict=True):
        cut = inner * (ours[0].shape[1] // (64 // side - 1)) + 1
        for a, b in zip(ours, theirs, strict=True):
            b = b[:, : a.shape[1], : a.shape[2]]
            assert torch.allclose(a[:, cut:-cut, cut:-cut], b[:, cut:-cut, cut:-cut])


@pytest.mark.parametrize(("wavelet", "levels"), [("haar", 2), ("db2", 1), ("sym4", 2)])
def test_blocks_of_one_piece_give_its_pixels_back(wavelet: str, levels: int) -> None:
    image, side = noise(3, 80, 80), 2**levels
    places = torch.zeros(12, 12, 3, dtype=torch.long)
    places[..., 1] = (5 + side * torch.arange(12))[:, None]
    places[..., 2] = 7 + side * torch.arange(12)
    whole = reconstruct(blocks_at([every_shift(image, wavelet, levels)], places))
    m = max(reach(wavelet, levels))
    inside = whole[:, m:-m, m:-m]
    there = image[:, 5 + m : 5 + 12 * side - m, 7 + m : 7 + 12 * side - m]
    assert torch.allclose(inside, there)


@pytest.mark.parametrize("boundary", ["free", "periodic"])
@pytest.mark.parametrize("levels", [1, 2])
def test_haar_copies_pixels(levels: int, boundary: str) -> None:
    z = stripes(40, 36)
    edge = "free" if boundary == "free" else "periodic"
    made = skeleton(z, (48, 40), levels=levels, mend=False, boundary=edge, seed=3)
    assert torch.equal(made.apply(z), made.texture)
    assert made.patches.shape == made.texture.shape[1:]
    assert made.report()["settings"]["made"] == [48, 40]
    source, side = made.source_map, 2**levels
    assert bool((source[::side, 1::side, 2] == source[::side, ::side, 2] + 1).all())


@pytest.mark.parametrize("boundary", ["free", "periodic"])
def test_a_longer_wavelet_blends_and_renders_maps_alike(boundary: str) -> None:
    z, edge = stripes(40, 40), "free" if boundary == "free" else "periodic"
    made = skeleton(z, (48, 40), wavelet="db2", mend=False, boundary=edge, seed=1)
    assert isinstance(made.field, BandField)
    assert torch.equal(made.apply(z).clamp(0, 1), made.texture)
    # all is linear, and constants stay
    assert torch.allclose(made.apply(0.5 * z + 0.2), 0.5 * made.apply(z) + 0.2)
    assert torch.allclose(made.apply(torch.ones_like(z)), torch.ones_like(made.texture))
    copies = SourceField(made.field.positions, made.field.weights, made.field.shapes).apply(z)
    assert 0 < (copies - made.texture).abs().mean() < 0.1


def test_a_map_far_from_seams_is_copied_by_a_longer_wavelet_too() -> None:
    z = noise(1, 40, 40)
    places = torch.zeros(8, 8, 3, dtype=torch.long)
    places[..., 1:] = torch.stack(
        torch.meshgrid(2 * torch.arange(8), 2 * torch.arange(8), indexing="ij"), -1
    )
    places[:, 4:, 2] += 11
    field = band_field(places, ((40, 40),), (12, 12), "db2", 1, 2)
    whole = field.apply(z)
    assert torch.allclose(whole[:, :, :3], z[:, 2:14, 2:5])
    assert torch.allclose(whole[:, :, 9:], z[:, 2:14, 22:25])
    assert not torch.allclose(whole[:, :, 5], z[:, 2:14, 7])


@pytest.mark.parametrize(("wavelet", "levels"), [("db2", 2), ("db8", 1)])
def test_a_free_border_does_not_meet_the_far_side(wavelet: str, levels: int) -> None:
    z = torch.linspace(0, 1, 64, dtype=torch.float64).expand(1, 64, 64).contiguous()
    made = skeleton(z, (24, 48), wavelet=wavelet, levels=levels, cut="none", schedule=QUICK)
    shape = BlockShape((24, 48), levels, wavelet, 1, "free")
    places = torch.zeros(*shape.blocks, 3, dtype=torch.long)
    places[..., 2] = 2**levels * torch.arange(shape.blocks[1]).clamp(max=(64 >> levels) - 1)
    m = shape.margin * 2**levels
    field = shape.field(places, [z], m)
    count = min(48, 64 - m - 2 * max(reach(wavelet, levels)))
    assert torch.allclose(field.apply(z)[0, :, :count], z[0, :24, m : m + count], atol=1e-9)
    assert made.texture.shape == (1, 24, 48)


def test_the_cut_lowers_the_cost_of_seams() -> None:
    z = noise(3, 48, 48)
    shape = BlockShape((64, 64), 1, "haar", 1, "free")
    space = shape.places([z], [None])
    seams = block_seams([z], space, shape.side, False)
    pick = torch.randint(len(space), (8, 8), generator=torch.Generator().manual_seed(0))
    blocks = space.positions[pick].repeat_interleave(4, 0).repeat_interleave(4, 1)
    blocks[..., 1:] = blocks[..., 1:].clamp(max=40)
    step = 2 * (torch.arange(32) % 4)
    blocks[..., 1] += step[:, None]
    blocks[..., 2] += step
    energies: list[float] = []
    seams.moved(blocks, None, lambda move, energy: energies.append(energy))
    assert energies == sorted(energies, reverse=True)
    assert energies[-1] < 0.95 * energies[0]


def test_the_cost_of_seams_is_that_of_the_pixels() -> None:
    z = noise(2, 12, 12)
    shape = BlockShape((8, 8), 1, "haar", 1, "free")
    space = shape.places([z], [None])
    seams = block_seams([z], space, shape.side, False)
    a, b = space.at(torch.tensor([[0, 3, 4]])), space.at(torch.tensor([[0, 6, 5]]))
    wanted = (z[:, 3:5, 6:8] - z[:, 6:8, 5:7]).square().sum()
    wanted = wanted + (z[:, 6:8, 3:5] - z[:, 3:5, 4:6]).square().sum()
    assert torch.allclose(seams._costs(a, b, 0), wanted[None])
    after = space.at(torch.tensor([[0, 3, 6]]))
    assert seams._costs(a, after, 0).item() == 0


@pytest.mark.parametrize("levels", [1, 3])
def test_odd_sizes_are_made_larger_and_cropped(levels: int) -> None:
    z, side = stripes(53, 61), 2**levels
    made = skeleton(z, (51, 67), levels=levels, seed=2)
    assert made.texture.shape == (3, 51, 67)
    assert made.settings["made"] == [-(-51 // side) * side, -(-67 // side) * side]
    assert made.settings["unused"] == [[53 % side, 61 % side]]
    every = skeleton(z, (51, 67), levels=levels, phases=side, seed=2)
    assert every.settings["unused"] == [[0, 0]]


def test_phases_bring_blocks_at_other_pixels() -> None:
    z = noise(1, 40, 40)
    one, more = (
        skeleton(z, (64, 64), phases=n, mend=False, schedule=QUICK, seed=4) for n in (1, 2)
    )
    assert set((one.source_map[::2, ::2, 1:] % 2).flatten().tolist()) == {0}
    assert set((more.source_map[::2, ::2, 1:] % 2).flatten().tolist()) == {0, 1}


@pytest.mark.parametrize("boundary", ["free", "periodic"])
@pytest.mark.parametrize(("wavelet", "levels", "phases"), [("haar", 2, 1), ("haar", 3, 4),
                                                          ("db2", 2, 2)])  # fmt: skip
def test_every_level_is_mended(wavelet: str, levels: int, phases: int, boundary: str) -> None:
    z, edge = stripes(64, 72), "free" if boundary == "free" else "periodic"
    plain, made = (
        skeleton(z, (64, 80), levels=levels, wavelet=wavelet, phases=phases, mend=mend,
                 boundary=edge, seed=1)
        for mend in (False, True)
    )  # fmt: skip
    assert made.settings["mend"]
    assert torch.equal(made.apply(z).clamp(0, 1), made.texture)
    assert not torch.equal(made.texture, plain.texture)
    if wavelet == "haar":  # others blend
        assert metrics.tail(made.texture, z) < metrics.tail(plain.texture, z)


@pytest.mark.parametrize("wavelet", ["db2", "db8"])
def test_with_a_longer_wavelet_pixels_far_from_seams_are_copies_and_none_rings(
    wavelet: str,
) -> None:
    z = stripes(64, 72).round()  # blends of it would leave its range
    plain, made = (
        skeleton(z, (48, 56), wavelet=wavelet, mend=mend, schedule=QUICK, seed=1)
        for mend in (False, True)
    )
    whole = plain.apply(z)
    assert whole.min() < -0.01
    assert whole.max() > 1.01
    assert torch.equal(made.apply(z), made.texture)
    assert made.texture.min() >= -1e-9
    assert made.texture.max() <= 1 + 1e-9
    assert metrics.tail(made.texture, z) < metrics.tail(plain.texture, z)


def test_halves_of_blocks_are_found_again() -> None:
    shape = BlockShape((32, 32), 2, "haar", 2, "free")
    zs = [noise(1, 24, 26), noise(1, 20, 31)]
    coarse, space = [shape.coarse(z) for z in zs], shape.places(zs, [None, None])
    corners = shape.exemplars(coarse, space)[2]
    places = torch.tensor([[[0, 4, 10], [1, 6, 8]]])
    assert torch.equal(shape.origins(shape.sources(places, corners), corners), places)
    assert shape.split(places)[:, :, 1:].tolist() == [
        [[4, 10], [4, 12], [6, 8], [6, 10]],
        [[6, 10], [6, 12], [8, 8], [8, 10]],
    ]


@pytest.mark.parametrize("wavelet", ["haar", "db2"])
def test_masks_are_kept(wavelet: str) -> None:
    mask = torch.zeros(48, 52, dtype=torch.bool)
    mask[3:, 11:] = True
    z = torch.where(mask, stripes(48, 52), torch.nan)
    made = skeleton(z, (40, 40), wavelet=wavelet, phases=2, masks=mask, seed=5)
    assert bool(made.texture.isfinite().all())
    source = made.source_map
    assert bool(mask[source[..., 1], source[..., 2]].all())
    assert torch.allclose(made.apply(mask[None].double()), torch.ones(1, 40, 40).double())


def test_several_exemplars_of_seven_channels() -> None:
    zs = [noise(7, 40, 36, seed=n) for n in (1, 2)]
    made = skeleton(zs, (48, 48), schedule=QUICK, seed=6)
    assert made.texture.shape == (7, 48, 48)
    assert torch.equal(made.apply(zs), made.texture)
    assert set(made.source_map[..., 0].flatten().tolist()) == {0, 1}


def test_a_periodic_texture_has_no_seam_at_its_border() -> None:
    z = stripes(64, 64)
    made = skeleton(z, (64, 64), boundary="periodic", seed=7)
    step = (made.texture.roll(-1, 2) - made.texture).abs().mean((0, 1))
    assert step[-1] < 2 * step[:-1].median()


def test_same_seed_same_bits_and_float32() -> None:
    z = stripes(40, 40).float()
    first, again = (skeleton(z, (48, 48), seed=8) for _ in range(2))
    assert torch.equal(first.texture, again.texture)
    assert first.texture.dtype == torch.float32
    assert not torch.equal(first.texture, skeleton(z, (48, 48), seed=9).texture)


def test_progress_ends_at_one_and_can_cancel() -> None:
    seen: list[float] = []
    skeleton(stripes(40, 40), (48, 48), on_step=lambda stage: seen.append(stage.done))
    assert seen == sorted(seen)
    assert seen[-1] <= 1

    def stop(stage: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        skeleton(stripes(40, 40), (48, 48), on_step=stop)


def test_wavelet_features_and_the_refinement() -> None:
    z = stripes(40, 40)
    made = skeleton(z, (48, 48), feature=Wavelets("haar", levels=1), schedule=QUICK)
    done = refine(made, z, steps=2)
    assert torch.equal(done.apply(z).clamp(0, 1), done.texture)
    assert done.settings["recipe"] == "skeleton"
    assert done.settings["refined"]["schedule"][0]["steps"] == 2
    assert done.seconds > made.seconds


def test_a_band_field_is_saved_and_read(tmp_path: Path) -> None:
    z = stripes(40, 40)
    made = skeleton(z, (44, 48), wavelet="db2", mend=False, schedule=QUICK)
    made.field.save(tmp_path / "l.npz")
    again = BandField.load(tmp_path / "l.npz")
    assert torch.equal(again.apply(z), made.apply(z))
    assert torch.equal(again.positions, made.field.positions)
    assert torch.equal(load_field(tmp_path / "l.npz").source_map(), made.source_map)
    skeleton(z, (44, 48), schedule=QUICK).field.save(tmp_path / "copies.npz")
    with pytest.raises(ValueError, match="is not a label file"):
        BandField.load(tmp_path / "copies.npz")
    (tmp_path / "text.npz").write_text("no")
    with pytest.raises(ValueError, match="is not a label file"):
        BandField.load(tmp_path / "text.npz")


def test_too_few_blocks_for_a_field() -> None:
    with pytest.raises(ValueError, match=r"size=9x8 with margin=0 is larger than the blocks, 8x8"):
        band_field(torch.zeros(4, 4, 3).long(), ((8, 8),), (9, 8), "haar", 1)
    assert block_pixels(torch.zeros(4, 4, 3).long(), 2).shape == (8, 8, 3)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("levels=0 must lie in 1..8", {"levels": 0}),
        ("levels=9 must lie in 1..8", {"levels": 9}),
        ("levels=3 is too many for exemplar=40x40", {"levels": 3}),
        ("levels=2 is too many for size=20x48", {"levels": 2, "size": (20, 48)}),
        ("wavelet='bior2.2' is not orthogonal", {"wavelet": "bior2.2"}),
        ("phases=3 must be a power of 2, at most 2^levels=2", {"phases": 3}),
        ("phases=4 must be a power of 2, at most 2^levels=2", {"phases": 4}),
        ("cut='dp' is unknown; choose mincut or none", {"cut": "dp"}),
        ('boundary="open" must be', {"boundary": "open"}),
        ("size=48x47 with a periodic boundary must be a multiple of 2^levels=2; choose 48x48",
         {"size": (48, 47), "boundary": "periodic"}),
        ("size=0x48 must be", {"size": (0, 48)}),
        ("seed=-1", {"seed": -1}),
    ],
)  # fmt: skip
def test_bad_options_get_a_sentence(words: str, options: dict[str, object]) -> None:
    given: dict[str, object] = {"size": (48, 48)} | options
    with pytest.raises(ValueError, match=re.escape(words)):
        skeleton(noise(3, 40, 40), **given)  # type: ignore[arg-type]


def test_masks_without_room_for_a_block() -> None:
    z, mask = noise(1, 48, 48), torch.eye(48, dtype=torch.bool)
    with pytest.raises(ValueError, match="no block of 2 pixels fits into the masks"):
        skeleton(z, (48, 48), masks=mask)
    mask = torch.zeros(48, 48, dtype=torch.bool)
    mask[1:3, 1:3] = True
    with pytest.raises(ValueError, match="the masks leave no block of 2 pixels whole"):
        skeleton(z, (48, 48), masks=mask)


def test_exemplars_of_the_seams_are_those_given() -> None:
    zs, keep = usable_exemplars([noise(1, 12, 14), noise(1, 16, 12)])
    shape = BlockShape((8, 8), 2, "haar", 1, "free")
    space = shape.places(zs, keep)
    seams = block_seams(zs, space, shape.side, False)
    assert seams.looks.shape == (len(space), 4)
    last = space.at(torch.tensor([[1, 12, 8]]))
    block = zs[1][0, 12:16, 8:12]
    means = torch.stack([block[:2, :2], block[:2, 2:], block[2:, :2], block[2:, 2:]]).mean((1, 2))
    assert torch.allclose(seams.looks[last][0], 2 * means)


def test_masks_that_leave_little_room_at_many_levels() -> None:
    z, mask = noise(1, 128, 128), torch.ones(128, 128, dtype=torch.bool)
    mask[56:72, 56:72] = False
    made = skeleton(z, (64, 64), levels=3, masks=mask)
    row, col = made.source_map[..., 1:].unbind(-1)
    assert bool(mask[row, col].all())
    mask[20:108, 20:108] = False
    with pytest.raises(ValueError, match="levels=3 is too many for these masks"):
        skeleton(z, (64, 64), levels=3, masks=mask)
