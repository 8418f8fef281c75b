"""Cyclic textures: sizes, sources, borders that continue, seams against brute force of choices."""

import itertools

import pytest
import torch
from conftest import noise, spots, stripes
from torch import Tensor

from torchtex import metrics
from torchtex.recipes.cyclic import BestOverlap, _cheapest, cyclic, seam_visibility
from torchtex.recipes.montage import Montage, Stage

CUTS = ("mincut", "dp")


def parted(tile: Montage) -> list[Tensor]:
    """Where neighbours on the torus, below and to the right, were no neighbours in the texture."""
    places = tile.field.positions[0, ..., 1:]
    return [
        ((places.roll(-1, axis) - places) != torch.tensor([1 - axis, axis])).any(-1)
        for axis in (0, 1)
    ]


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("opening", ["best", "half"])
@pytest.mark.parametrize("channels", [1, 3, 4, 7])
def test_sizes_and_sources(cut: str, opening: str, channels: int) -> None:
    texture = noise(channels, 24, 30)
    tile = cyclic(texture, overlap=(6, 9), cut=cut, opening=opening)  # type: ignore[arg-type]
    assert tile.texture.shape == (channels, 18, 21)
    assert torch.equal(tile.apply(texture), tile.texture)
    other = noise(2, 24, 30, seed=1)
    assert tile.apply(other).shape == (2, 18, 21)
    assert tile.settings["overlap"] == [6, 9]


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("overlap", [(6, 9), (12, 15), (2, 2)])
def test_each_place_is_its_own_or_a_period_away(cut: str, overlap: tuple[int, int]) -> None:
    tile = cyclic(noise(3, 24, 30), overlap=overlap, cut=cut)  # type: ignore[arg-type]
    places = tile.field.positions[0, ..., 1:]
    for axis, period in ((0, 24 - overlap[0]), (1, 30 - overlap[1])):
        line = places[..., axis] % period
        order = line if axis == 0 else line.T
        assert (order == order[:, :1]).all()  # the same line of the tube all along
        assert ((order[1:, 0] - order[:-1, 0]) % period == 1).all()


@pytest.mark.parametrize("cut", CUTS)
def test_the_border_is_whole_and_every_line_is_parted_an_odd_number_of_times(cut: str) -> None:
    tile = cyclic(noise(3, 40, 44), overlap=(8, 10), cut=cut, opening="half")  # type: ignore[arg-type]
    places = tile.field.positions[0, ..., 1:]
    for axis in (0, 1):
        jumps = (places.roll(-1, axis) - places)[..., axis] != 1
        assert not jumps.select(axis, -1).any()
        # a seam may turn back, but each line begins anew once more than it goes back
        assert (jumps.sum(axis) % 2 == 1).all()
    below, right = parted(tile)
    patches = tile.patches
    for axis, cuts in ((0, below), (1, right)):
        changes = patches != patches.roll(-1, axis)
        inner = changes.narrow(axis, 0, changes.shape[axis] - 1)
        assert torch.equal(inner, cuts.narrow(axis, 0, cuts.shape[axis] - 1))


@pytest.mark.parametrize("cut", CUTS)
def test_a_periodic_texture_joins_without_a_step(cut: str) -> None:
    block = noise(3, 20, 16)
    texture = block.repeat(1, 2, 3)[:, :28, :42]
    tile = cyclic(texture, cut=cut)  # type: ignore[arg-type]
    h, w = tile.texture.shape[1:]
    assert (h % 20, w % 16) == (0, 0)
    roll = next(
        (i, j)
        for i, j in itertools.product(range(20), range(16))
        if torch.equal(block.roll((i, j), (1, 2)), tile.texture[:, :20, :16])
    )
    assert torch.equal(block.roll(roll, (1, 2)).repeat(1, h // 20, w // 16), tile.texture)


def test_the_best_overlap_has_the_cheapest_path_of_all() -> None:
    errors = noise(4, 5, 3)
    for error, found in zip(errors, _cheapest(errors), strict=True):
        paths = [
            sum(float(error[i, j]) for i, j in enumerate(p))
            for p in itertools.product(range(3), repeat=5)
            if all(abs(a - b) <= 1 for a, b in itertools.pairwise(p))
        ]
        assert float(found) == pytest.approx(min(paths))
    assert BestOverlap(0.1, 0.4).range(100) == (10, 40)
    exact = cyclic(stripes(48, 40), overlap=BestOverlap(slack=0.0))
    loose = cyclic(stripes(48, 40), overlap=BestOverlap(slack=1.0))
    assert loose.texture.shape[2] >= exact.texture.shape[2]


def test_a_cut_beats_a_straight_border_and_the_border_is_no_worse_than_inside() -> None:
    for texture in (stripes(64, 60), spots(64)):
        tile = cyclic(texture)
        # as visible as lines inside, or less; and far less than the plain texture tiled
        assert metrics.seam(tile.texture) <= 1.1
        assert metrics.seam(tile.texture, segment=16) <= 1.1
        cut = seam_visibility(tile)
        assert cut.mean < 1.5


def test_min_cut_is_no_dearer_than_a_path_in_its_own_costs() -> None:
    def cost(tile: Montage) -> float:
        x, total = tile.texture, 0.0
        for axis, cuts in zip((1, 2), parted(tile), strict=True):
            total += float(((x.roll(-1, axis) - x).abs().mean(0) * cuts).sum())
        return total

    better = [
        cost(cyclic(noise(3, 40, 40, seed=s), overlap=(12, 12)))
        < cost(cyclic(noise(3, 40, 40, seed=s), overlap=(12, 12), cut="dp"))
        for s in range(5)
    ]
    assert sum(better) >= 4


def test_poisson_keeps_the_mean_and_softens_the_steps() -> None:
    ramp = stripes(48, 48) * torch.linspace(0.4, 1, 48, dtype=torch.float64)
    plain = cyclic(ramp, overlap=(12, 12))
    soft = cyclic(ramp, overlap=(12, 12), poisson=True)
    assert torch.equal(plain.patches, soft.patches)
    assert soft.texture.mean() == pytest.approx(float(plain.texture.mean()), abs=1e-3)
    assert seam_visibility(soft).mean < seam_visibility(plain).mean
    assert 0 <= soft.texture.min() <= soft.texture.max() <= 1
    periodic = noise(1, 12, 12).repeat(1, 2, 2)
    tile = cyclic(periodic, overlap=(12, 12))
    again = cyclic(periodic, overlap=(12, 12), poisson=True)
    torch.testing.assert_close(tile.texture, again.texture)  # no seam, nothing to soften


def test_opening_moves_the_tile_and_changes_no_pixel_of_the_plane() -> None:
    half, best = (
        cyclic(noise(2, 24, 26), overlap=(6, 6), opening=o)  # type: ignore[arg-type]
        for o in ("half", "best")
    )
    assert any(
        torch.equal(half.texture.roll((i, j), (1, 2)), best.texture)
        for i in range(18)
        for j in range(20)
    )


def test_dtype_bits_steps_and_cancel() -> None:
    texture = stripes(30, 30).float()
    stages: list[Stage] = []
    tile = cyclic(texture, on_step=stages.append)
    assert tile.texture.dtype == torch.float32
    assert [s.done for s in stages] == sorted(s.done for s in stages)
    assert stages[-1].done == 1
    torch.set_num_threads(2)
    assert torch.equal(tile.texture, cyclic(texture).texture)

    def stop(_: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cyclic(texture, on_step=stop)


def test_refuses(unchecked: None) -> None:
    texture = noise(3, 20, 24)
    with pytest.raises(ValueError, match=r"overlap=11x4: of the 20 rows .* between 2 and 10"):
        cyclic(texture, overlap=(11, 4))
    with pytest.raises(ValueError, match="overlap=4x13: of the 24 columns"):
        cyclic(texture, overlap=(4, 13))
    with pytest.raises(ValueError, match="overlap=1x4"):
        cyclic(texture, overlap=(1, 4))
    with pytest.raises(ValueError, match="3x24 is too small"):
        cyclic(texture[:, :3])
    with pytest.raises(ValueError, match="cut='graph' is unknown"):
        cyclic(texture, cut="graph")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="opening='third'"):
        cyclic(texture, opening="third")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="NaN"):
        cyclic(texture * torch.nan)
    with pytest.raises(ValueError, match=r"least=0\.3, most=0\.2"):
        BestOverlap(0.3, 0.2)
    with pytest.raises(ValueError, match="slack=-1"):
        BestOverlap(slack=-1.0)
