"""Image quilting and texture transfer: copies that fit, sizes, options that make no sense."""

from typing import Any

import pytest
import torch
from conftest import noise, spots, stripes

from torchtex.cuts.mincut import OrTools
from torchtex.recipes.correspondence import Correspondence, blurred_luminance
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.quilting import quilt, transfer


def fits(result: Montage, exemplars: Any) -> None:
    """Every pixel is a copy, and one patch copies one place."""
    assert torch.equal(result.apply(exemplars), result.texture)
    h, w = result.patches.shape
    at = torch.stack(torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij"), -1)
    shift = result.source_map[..., 1:] - at
    for number in result.patches.unique():
        assert len(shift[result.patches == number].unique(dim=0)) == 1


@pytest.mark.parametrize("cut", ["dp", "mincut"])
@pytest.mark.parametrize("size", [(50, 41), (1, 1), (12, 12), (13, 30), (9, 60)])
def test_the_texture_is_a_copy_of_places(cut: Any, size: tuple[int, int]) -> None:
    z = stripes(32, 36)
    result = quilt(z, size, block=12, cut=cut, seed=1)
    assert result.texture.shape == (3, *size)
    fits(result, z)


@pytest.mark.parametrize("channels", [1, 3, 4, 7])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_channels_and_dtype(channels: int, dtype: torch.dtype) -> None:
    z = noise(channels, 20, 24, seed=2, dtype=dtype)
    for result in (quilt(z, (30, 33), seed=3), transfer(z, z[:2, :15], iterations=2, seed=3)):
        assert result.texture.dtype == dtype
        assert len(result.texture) == channels
        fits(result, z)


def test_blocks_join_better_than_blocks_at_random() -> None:
    z = stripes(48, 48, channels=1, seed=4)

    def step(texture: torch.Tensor) -> float:
        return float((texture[:, :, 1:] - texture[:, :, :-1]).square().mean())

    free = quilt(z, (64, 64), block=12, overlap=3, tolerance=1e9, seed=0)
    fitted = quilt(z, (64, 64), block=12, overlap=3, tolerance=0.0, seed=0)
    assert step(fitted.texture) < 1.1 * step(z)
    assert step(fitted.texture) < step(free.texture)


def test_continuing_copies_the_exemplar_until_its_border() -> None:
    z = noise(1, 40, 40, seed=5)
    result = quilt(z, (16, 22), block=10, overlap=2, tolerance=0.0, continuing=True, seed=10)
    source = result.source_map
    where = tuple(source[0, 0].tolist())
    row, col = where[1:]
    rows, cols = min(16, 32 - row), min(22, 32 - col)
    assert torch.equal(result.texture[:, :rows, :cols], z[:, row : row + rows, col : col + cols])
    apart = quilt(z, (16, 22), block=10, overlap=2, tolerance=0.0, seed=10)
    assert not torch.equal(apart.texture, result.texture)


def test_where_only_the_continuation_is_left_it_is_taken() -> None:
    z = noise(1, 8, 11, seed=5)
    result = quilt(z, (8, 30), block=8, overlap=2, seed=1)
    fits(result, z)


def test_several_exemplars_and_masks() -> None:
    zs = [stripes(24, 24), noise(3, 20, 30, seed=7)]
    masks = [torch.ones(24, 24, dtype=torch.bool), torch.zeros(20, 30, dtype=torch.bool)]
    masks[0][:, :6] = False
    masks[1][:12, 15:] = True
    zs[0][0, 3, 3] = torch.nan
    result = quilt(zs, (60, 60), block=10, tolerance=5.0, masks=masks, seed=8)
    number, row, col = result.source_map.flatten(0, 1).T
    assert number.unique().tolist() == [0, 1]
    for n in (0, 1):
        assert masks[n][row[number == n], col[number == n]].all()
    assert result.texture.isfinite().all()
    grey = blurred_luminance([zs[1]], noise(1, 20, 20), masks=[masks[1]])
    assert grey.target.max() <= grey.exemplars[0][0, masks[1]].max()


def test_same_seed_same_bits_for_any_number_of_threads() -> None:
    z, target = noise(3, 24, 24, dtype=torch.float32), noise(1, 30, 30, seed=1)
    made = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        made.append(
            [
                quilt(z, (40, 40), seed=5).texture,
                quilt(z, (40, 40), cut="mincut", seed=5).texture,
                transfer(z, target, seed=5).texture,
            ]
        )
        assert torch.get_num_threads() == threads
    assert all(torch.equal(a, b) for a, b in zip(*made, strict=True))
    assert not torch.equal(quilt(z, (40, 40), seed=6).texture, made[0][0])


def test_solvers_agree() -> None:
    z = noise(1, 20, 20, seed=3)
    ours = quilt(z, (30, 30), cut="mincut", seed=1)
    theirs = quilt(z, (30, 30), cut="mincut", solver=OrTools(), seed=1)
    assert torch.equal(ours.texture, theirs.texture)


def test_transfer_shows_the_target() -> None:
    z = spots(48) + 0.3 * torch.linspace(-1, 1, 48, dtype=torch.float64)
    target = torch.zeros(1, 40, 40, dtype=torch.float64)
    target[:, 10:30, 10:30] = 1
    result = transfer(z.clamp(0, 1), target, seed=1)
    fits(result, z.clamp(0, 1))
    inside = result.texture[:, 12:28, 12:28].mean()
    outside = result.texture[:, :8].mean()
    assert inside > outside + 0.1


def test_transfer_by_given_maps() -> None:
    z = noise(3, 24, 24, seed=1)
    halves = torch.zeros(2, 24, 24, dtype=torch.float64)
    halves[0, :, :12] = 1
    target = torch.zeros(2, 20, 26, dtype=torch.float64)
    target[0, :10] = 1
    maps = Correspondence((halves,), target)
    result = transfer(z, noise(1, 20, 26), correspondence=maps, iterations=1, tolerance=0.0)
    assert (result.source_map[:8, :, 2] < 12).all()
    assert (result.source_map[12:, :, 2] >= 12).all()


def test_steps_are_told_and_may_cancel() -> None:
    stages: list[Stage] = []
    z = noise(1, 20, 20)
    quilt(z, (40, 20), block=12, overlap=2, on_step=stages.append)
    assert [round(stage.done, 3) for stage in stages] == [0.25, 0.5, 0.75, 1.0]
    assert all(stage.texture.shape == (1, 40, 20) for stage in stages)
    stages.clear()
    transfer(z, z, block=12, overlap=2, on_step=stages.append)
    assert {stage.note for stage in stages} == {f"iteration {i} of 3" for i in (1, 2, 3)}
    assert stages[-1].done == 1.0

    def cancel(stage: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        quilt(z, (40, 20), on_step=cancel)


def test_report_holds_the_settings() -> None:
    result = quilt(noise(1, 25, 50), (30, 30), seed=4)
    assert result.report()["settings"] == {
        "recipe": "quilt", "continuing": False, "size": [30, 30], "block": 7, "overlap": 1,
        "tolerance": 0.1, "cut": "dp",
    }  # fmt: skip
    assert result.seed == 4


Z = noise(3, 20, 24)
NONE = torch.zeros(20, 24, dtype=torch.bool)
SMALL = NONE.clone()
SMALL[3:5] = True


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("block=21 must lie in 3..20", {"block": 21}),
        ("block=2 must lie", {"block": 2}),
        ("overlap=6 must be at least 1, less than half of block=12", {"block": 12, "overlap": 6}),
        ("overlap=0", {"overlap": 0}),
        ("overlap=4 .* half of size=7x30", {"block": 12, "overlap": 4, "size": (7, 30)}),
        ("size=0x5", {"size": (0, 5)}),
        ("size=5x-1", {"size": (5, -1)}),
        ("tolerance=-0.1", {"tolerance": -0.1}),
        ("tolerance=nan", {"tolerance": float("nan")}),
        ("seed=-1", {"seed": -1}),
        ("cut='best' is unknown", {"cut": "best"}),
        ("exemplar: none", {"exemplars": []}),
        ("one has 3 channels and another 1", {"exemplars": [Z, Z[:1]]}),
        ("exemplar holds NaN", {"exemplars": Z / 0}),
        ("block=3 must lie in 3..2", {"exemplars": Z[:, :2]}),
        ("mask: 1 given for 2", {"exemplars": [Z, Z], "masks": NONE}),
        ("mask is 20x23", {"masks": NONE[:, 1:]}),
        ("block=6 fits nowhere in the masks", {"masks": SMALL}),
    ],
)
def test_what_makes_no_sense_is_refused(words: str, options: dict[str, Any]) -> None:
    given = {"exemplars": Z, "size": (30, 30)} | options
    with pytest.raises(ValueError, match=words):
        quilt(given.pop("exemplars"), given.pop("size"), **given)


@pytest.mark.usefixtures("unchecked")
def test_what_makes_no_sense_for_a_transfer_is_refused() -> None:
    with pytest.raises(ValueError, match="iterations=0"):
        transfer(Z, Z, iterations=0)
    with pytest.raises(ValueError, match="target holds NaN"):
        transfer(Z, Z / 0)
    with pytest.raises(ValueError, match="correspondence of the target is 20x24"):
        transfer(Z, Z[:, :8], correspondence=Correspondence((Z,), Z))
    with pytest.raises(ValueError, match="map is 20x23"):
        transfer(Z, Z, correspondence=Correspondence((Z[..., 1:],), Z))
    with pytest.raises(ValueError, match="map: 2 given for 1"):
        transfer(Z, Z, correspondence=Correspondence((Z, Z), Z))
