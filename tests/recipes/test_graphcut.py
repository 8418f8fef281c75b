"""Graphcut textures: copies of the exemplar everywhere, seams that only get better."""

import math
import re
import sys

import pytest
import torch
from conftest import noise, spots, stripes
from torch import Tensor

from torchtex.cuts.mincut import OrTools, solvers
from torchtex.metrics import seam
from torchtex.recipes.graphcut import EntirePatch, Placement, Random, SubPatch, graphcut
from torchtex.recipes.montage import Montage, Stage

PLACEMENTS = [Random(), EntirePatch(), SubPatch(), SubPatch(patch=10, k=0.1)]


def every_pixel_is_the_exemplars(result: Montage, z: Tensor) -> None:
    """By the whole positions of the field, without its renderer."""
    positions = result.field.positions[0]
    assert torch.equal(positions, positions.round())
    assert torch.equal(result.texture, z[:, positions[..., 1].long(), positions[..., 2].long()])


@pytest.mark.parametrize("placement", PLACEMENTS, ids=str)
@pytest.mark.parametrize("size", [(48, 70), (20, 90), (1, 40), (33, 33)])
def test_pixels_are_copies_from_where_the_field_says(
    placement: Placement, size: tuple[int, int]
) -> None:
    z = stripes(32, 30)
    if isinstance(placement, SubPatch) and placement.patch is not None:
        size = (max(size[0], placement.patch), size[1])
    result = graphcut(z, size, placement=placement, refine=4, seed=1)
    assert result.texture.shape == (3, *size)
    assert result.texture.dtype == z.dtype
    every_pixel_is_the_exemplars(result, z)
    assert torch.equal(result.apply(z), result.texture)
    assert int(result.patches.max()) + 1 == len(result.patches.unique())


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 7])
def test_any_number_of_channels_and_both_dtypes(channels: int) -> None:
    for dtype in (torch.float32, torch.float64):
        z = stripes(24, 24, channels).to(dtype)
        result = graphcut(z, (30, 40), refine=2)
        assert result.texture.dtype == dtype
        assert torch.equal(result.apply(z), result.texture)


def test_a_patch_keeps_its_place_in_the_exemplar() -> None:
    z = noise(2, 30, 30)
    result = graphcut(z, (50, 50), seed=3)
    inside = ~result.seams[:-1, :-1]
    source = result.source_map[..., 1:]
    across = (source[:-1, 1:] - source[:-1, :-1])[inside]
    down = (source[1:, :-1] - source[:-1, :-1])[inside]
    assert torch.equal(across, torch.tensor([0, 1]).expand_as(across))
    assert torch.equal(down, torch.tensor([1, 0]).expand_as(down))


@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.parametrize("boundary", ["free", "periodic"])
@pytest.mark.parametrize("placement", PLACEMENTS[:3], ids=str)
def test_refinement_never_raises_the_cost_of_the_seams(
    placement: Placement, gradient: bool, boundary: str
) -> None:
    z = spots(32) if boundary == "free" else stripes(32)
    costs = []
    for refine in (0, 3, 12):
        result = graphcut(
            z, (60, 56), placement=placement, gradient=gradient, refine=refine,
            boundary="free" if boundary == "free" else "periodic", seed=5,
        )  # fmt: skip
        costs.append(result.settings["seam_cost"])
        assert result.settings["seam_cost_before_refinement"] == costs[0]
    assert costs[0] >= costs[1] >= costs[2] > 0
    assert costs[2] < costs[0]


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("gradient", [False, True])
def test_the_cost_is_that_of_the_formula_pixel_by_pixel(periodic: bool, gradient: bool) -> None:
    z = noise(2, 20, 20, seed=2)
    # scaled by one the positions are enough to know what each patch shows beside a pixel
    result = graphcut(z, (26, 30), gradient=gradient, refine=3, seed=1,
                      boundary="periodic" if periodic else "free")  # fmt: skip
    source, patches = result.source_map, result.patches

    def shown(i: int, j: int, down: int, right: int) -> Tensor:
        row, col = int(source[i, j, 1]) + down, int(source[i, j, 2]) + right
        return z[:, min(max(row, 0), 19), min(max(col, 0), 19)]

    total = 0.0
    for i in range(26):
        for j in range(30):
            for down, right in ((0, 1), (1, 0)):
                a, b = i + down, j + right
                if (a == 26 or b == 30) and not periodic:
                    continue
                a, b = a % 26, b % 30
                first, ahead = shown(i, j, 0, 0), shown(i, j, down, right)
                second, back = shown(a, b, 0, 0), shown(a, b, -down, -right)
                cost = float((first - back).norm() + (ahead - second).norm())
                if gradient:
                    cost /= 2 * float((ahead - first).norm() + (second - back).norm()) + 0.01
                if patches[i, j] != patches[a, b]:
                    total += cost
                else:
                    assert cost == 0
    assert math.isclose(result.settings["seam_cost"], total, rel_tol=1e-9)


def test_cheaper_seams_than_patches_at_random() -> None:
    z = stripes(40, 40)
    cost = {
        placement: graphcut(z, (72, 72), placement=placement, refine=0).settings["seam_cost"]
        for placement in (Random(), EntirePatch(), SubPatch())
    }
    assert cost[EntirePatch()] < 0.7 * cost[Random()]
    assert cost[SubPatch()] < 0.7 * cost[Random()]


def test_a_periodic_exemplar_goes_on_without_a_seam() -> None:
    tile = noise(3, 8, 8)
    z = tile.repeat(1, 4, 4)
    for placement in (EntirePatch(k=1e-4), SubPatch(k=1e-4)):
        result = graphcut(z, (64, 72), placement=placement)
        assert result.settings["seam_cost"] < 1e-9
        assert torch.equal(result.texture[:, 8:], result.texture[:, :-8])
        assert torch.equal(result.texture[:, :, 8:], result.texture[:, :, :-8])


def test_turned_and_mirrored_patches() -> None:
    z = noise(3, 20, 26, seed=4)
    result = graphcut(z, (60, 60), turns=True, mirrors=True, placement=Random(), refine=6)
    every_pixel_is_the_exemplars(result, z)
    assert torch.equal(result.apply(z), result.texture)
    source = result.source_map[..., 1:]
    steps = (source[:, 1:] - source[:, :-1])[~result.seams[:, :-1]].unique(dim=0)
    assert len(steps) == 4  # to the right of a pixel lies one of all four neighbors
    plain = graphcut(z, (60, 60), mirrors=True, placement=Random()).source_map[..., 1]
    assert bool((plain[1:] - plain[:-1] >= -19).all())


def test_scaled_patches_read_between_pixels() -> None:
    z = stripes(30, 30)
    result = graphcut(z, (50, 50), scales=(0.8, 1.0, 1.25), turns=True, refine=3, seed=2)
    assert result.field.positions.is_floating_point()
    assert torch.equal(result.apply(z), result.texture)
    maps = noise(2, 30, 30)
    assert result.apply(maps).shape == (2, 50, 50)
    rows = result.field.positions[0, ..., 1]
    assert not torch.equal(rows, rows.round())


def test_several_exemplars_all_take_part() -> None:
    zs = [noise(1, 24, 24, seed=1), noise(1, 30, 20, seed=2)]
    result = graphcut(zs, (64, 64), placement=Random(), seed=1)
    assert set(result.source_map[..., 0].unique().tolist()) == {0, 1}
    assert torch.equal(result.apply(zs), result.texture)


@pytest.mark.parametrize("placement", PLACEMENTS[:3], ids=str)
def test_masks_are_kept(placement: Placement) -> None:
    z = stripes(32, 32)
    mask = torch.ones(32, 32, dtype=torch.bool)
    mask[4:12, 8:20] = False
    mask[:, 30:] = False
    z[:, ~mask] = torch.nan
    for boundary in ("free", "periodic"):
        result = graphcut(
            z, (50, 50), placement=placement, masks=mask, refine=6, turns=True,
            boundary="free" if boundary == "free" else "periodic",
        )  # fmt: skip
        source = result.source_map
        assert bool(mask[source[..., 1], source[..., 2]].all())
        assert bool(result.texture.isfinite().all())


def test_a_single_usable_pixel_fills_the_canvas() -> None:
    mask = torch.zeros(12, 12, dtype=torch.bool)
    mask[3, 5] = True
    z = noise(3, 12, 12)
    result = graphcut(z, (5, 6), masks=mask)
    assert torch.equal(result.texture, z[:, 3:4, 5:6].expand(-1, 5, 6))


def test_an_exemplar_larger_than_the_canvas() -> None:
    z = stripes(64, 64)
    for boundary in ("free", "periodic"):
        for placement in PLACEMENTS[:3]:
            result = graphcut(
                z, (20, 24), placement=placement,
                boundary="free" if boundary == "free" else "periodic",
            )  # fmt: skip
            every_pixel_is_the_exemplars(result, z)


def test_a_tiny_exemplar() -> None:
    for side in (1, 2, 3):
        z = noise(1, side, side)
        result = graphcut(z, (9, 7))
        assert set(result.texture.flatten().tolist()) <= set(z.flatten().tolist())


def test_a_periodic_texture_has_no_seam_at_its_border() -> None:
    z = stripes(40, 40)
    tiles = graphcut(z, (64, 64), boundary="periodic", seed=2)
    cut = graphcut(z, (64, 64), seed=2)
    assert seam(tiles.texture) < seam(cut.texture)


def test_poisson_levels_what_the_seams_leave() -> None:
    z = stripes(32, 32)
    z = (z * 0.6 + torch.linspace(0, 0.4, 32, dtype=torch.float64)).clamp(0, 1)
    plain = graphcut(z, (60, 60), seed=1)
    for boundary in ("free", "periodic"):
        levelled = graphcut(
            z, (60, 60), poisson=True, seed=1,
            boundary="free" if boundary == "free" else "periodic",
        )  # fmt: skip
        assert float(levelled.texture.min()) >= 0
        assert float(levelled.texture.max()) <= 1
    smooth = graphcut(z, (60, 60), poisson=True, seed=1)
    assert torch.equal(smooth.source_map, plain.source_map)
    steps = []
    for result in (plain, smooth):
        there = result.patches[:, 1:] != result.patches[:, :-1]
        own = plain.texture[:, :, 1:] - plain.texture[:, :, :-1]
        change = (result.texture[:, :, 1:] - result.texture[:, :, :-1]).abs()
        steps.append((float(change[:, there].mean()), float(own.abs()[:, ~there].mean())))
    assert steps[1][0] < steps[0][0]
    alone = graphcut(z, (20, 20), poisson=True, refine=0, seed=1)  # one patch
    assert torch.allclose(alone.texture, alone.apply(z), atol=1e-9)


def test_same_seed_same_bits_whatever_the_threads() -> None:
    z = stripes(32, 32).float()

    def made(seed: int) -> Tensor:
        return graphcut(z, (70, 70), seed=seed, poisson=True, mirrors=True).texture

    one = made(7)
    torch.set_num_threads(2)
    assert torch.equal(made(7), one)
    assert not torch.equal(made(8), one)


def test_the_result_does_not_depend_on_the_solvers_choice_of_numbers() -> None:
    if not solvers()["ortools"]:
        pytest.skip("ortools is not installed")
    z = noise(3, 24, 24)
    first, second = (graphcut(z, (40, 40), solver=s, seed=1) for s in (None, OrTools()))
    assert math.isclose(first.settings["seam_cost"], second.settings["seam_cost"], rel_tol=1e-6)


def test_steps_are_told_and_can_cancel() -> None:
    stages: list[Stage] = []
    graphcut(stripes(24, 24), (60, 60), refine=5, on_step=stages.append)
    done = [stage.done for stage in stages]
    assert done == sorted(done)
    assert done[-1] == 1
    assert {stage.note for stage in stages} == {"filling", "refining"}
    assert stages[0].texture.shape == (3, 60, 60)

    def stop(stage: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        graphcut(stripes(24, 24), (60, 60), on_step=stop)


def test_the_report_is_plain() -> None:
    result = graphcut(stripes(24, 24), (40, 40), placement=SubPatch(patch=9), refine=2)
    settings = result.report()["settings"]
    assert settings["placement"] == "SubPatch"
    assert settings["patch"] == 9
    assert settings["refine"] == 2
    assert result.report()["patches"] == len(result.patches.unique())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"placement": SubPatch(patch=25)}, "patch=25 is larger than an exemplar"),
        ({"placement": SubPatch(patch=22), "size": (20, 50)}, "patch=22 is larger than size=20x50"),
        ({"placement": SubPatch(patch=13), "scales": (0.5,)}, "patch=13 is larger than an exempl"),
        ({"refine": -1}, "refine=-1"),
        ({"scales": (0.0,)}, "scales=0.0"),
        ({"scales": (-1.0,)}, "scales=-1.0"),
        ({"scales": (math.nan,)}, "scales=nan"),
        ({"scales": ()}, "scales is empty"),
        ({"size": (0, 5)}, "size=0x5"),
        ({"boundary": "open"}, 'boundary="open"'),
        ({"seed": -1}, "seed=-1"),
        ({"seed": 2**63}, "seed=9223372036854775808"),
        ({"masks": torch.zeros(24, 24, dtype=torch.bool)}, "mask is empty"),
        ({"masks": torch.ones(9, 24, dtype=torch.bool)}, "mask is 9x24"),
        ({"masks": [None, None]}, "mask: 2 given for 1"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_options_are_named(options: dict[str, object], words: str) -> None:
    size = options.pop("size", (30, 30))
    with pytest.raises(ValueError, match=re.escape(words)):
        graphcut(stripes(24, 24), size, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SubPatch(patch=0), "patch=0"),
        (lambda: SubPatch(k=0.0), "k=0.0"),
        (lambda: EntirePatch(k=math.inf), "k=inf"),
        (lambda: EntirePatch(k=math.nan), "k=nan"),
        (lambda: EntirePatch(spread=-1.0), "spread=-1.0"),
        (lambda: graphcut([], (9, 9)), "none given"),
        (lambda: graphcut([noise(1, 9, 9), noise(2, 9, 9)], (9, 9)), "1 channels and another 2"),
        (lambda: graphcut(noise(1, 9, 9) / 0, (9, 9)), "NaN or infinity"),
    ],
)
def test_bad_placements_and_exemplars_are_named(make: object, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        make()  # type: ignore[operator]


def test_without_a_solver_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("maxflow", "ortools.graph.python.max_flow"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError) as caught:
        graphcut(stripes(24, 24), (30, 30))
    assert "torchtex[graphcut]" in str(caught.value)


def test_spread_shows_more_of_the_exemplar() -> None:
    z = noise(1, 36, 36)
    missed = []
    for spread in (0.0, 3.0):
        result = graphcut(z, (90, 90), placement=SubPatch(spread=spread), seed=1)
        source = result.source_map[..., 1] * 36 + result.source_map[..., 2]
        counts = torch.bincount(source.flatten(), minlength=36 * 36).double()
        missed.append(float(counts.std() / counts.mean()))
    assert missed[1] < missed[0]
