"""Designs: copies of the exemplars, one for each seed, tileable on demand."""

from dataclasses import replace

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex.layers.deform import Deformation, Spread
from torchtex.layers.plans import Chaos, Operation, Plan
from torchtex.layers.segment import Segmentation, segment
from torchtex.recipes.carried import onto
from torchtex.recipes.design import design, designs
from torchtex.recipes.design_parts import ENLARGE, Enlarge, Layering, whole_deformed
from torchtex.recipes.layered import Filling, layered
from torchtex.recipes.montage import Montage, Stage
from torchtex.sources import copied

FILLING = Filling(patch=12, rim=4)
QUICK = Layering(layers=2, filling=FILLING)


def dots(channels: int = 3, side: int = 48, seed: int = 0) -> Tensor:
    """Bright disks on a dark ground, with grain."""
    row, col = torch.arange(side)[:, None], torch.arange(side)
    image = torch.full((channels, side, side), 0.2, dtype=torch.float64)
    for y, x, radius in ((12, 12, 7), (14, 34, 8), (34, 20, 9), (36, 40, 5)):
        image[:, (row - y) ** 2 + (col - x) ** 2 <= radius**2] = 0.8
    return (image + 0.1 * (noise(channels, side, side, seed=seed) - 0.5)).clamp(0, 1)


# --------------------------------------------------------------------------------- layers


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("children", [True, False])
def test_layered_pixels_are_read_from_the_exemplar(channels: int, children: bool) -> None:
    z = dots(channels)
    made = layered(z, [segment(z, 2)], filling=FILLING, children=children, seed=1)
    assert made.texture.shape == z.shape
    assert torch.equal(made.apply(z), made.texture)
    assert int(made.patches.min()) >= 0
    assert made.settings["holes"] > 0
    assert len(made.settings["plan"]) == (5 if children else 2)
    assert not torch.equal(made.texture, z)


def test_a_recorded_plan_repeats_a_texture_and_can_be_edited() -> None:
    z = dots()
    parts = [segment(z, 2)]
    first = layered(z, parts, filling=FILLING, seed=3)
    plan = Plan.read(first.settings["plan"])
    assert torch.equal(layered(z, parts, filling=FILLING, plan=plan).texture, first.texture)
    none = Plan(tuple(() for _ in plan.layers))
    still = layered(z, parts, filling=FILLING, plan=none)
    assert torch.equal(still.texture, z)
    edited = Plan(((), (Operation("mirror", "up-down"),), *none.layers[2:]))
    moved = layered(z, parts, filling=FILLING, plan=edited)
    assert not torch.equal(moved.texture, z)
    far = torch.ones(48, 48, dtype=torch.bool)
    far[:26, :26] = False
    assert torch.equal(moved.texture[:, far], z[:, far])  # only one piece was touched
    with pytest.raises(ValueError, match="plan has 1 lists of operations for 5 pieces"):
        layered(z, parts, plan=Plan(((),)))


def test_layers_fill_any_size_from_several_exemplars() -> None:
    zs = [dots(seed=1), dots(side=40, seed=2)]
    parts = [segment(z, 2) for z in zs]
    made = layered(zs, parts, (70, 90), filling=FILLING, seed=2)
    assert made.texture.shape == (3, 70, 90)
    assert torch.equal(made.apply(zs), made.texture)
    assert set(made.source_map[..., 0].unique().tolist()) == {0, 1}


def test_a_layer_that_vanishes_is_refused_and_a_small_one_is_shown() -> None:
    z = dots()
    labels = torch.zeros(48, 48, dtype=torch.long)
    labels[20:24, 20:24] = 1  # too small for a seam in it
    parts = [Segmentation(labels, labels)]
    made = layered(z, parts, filling=FILLING)
    assert torch.equal(made.apply(z), made.texture)
    step = Operation("scale", "", 0.1)
    with pytest.raises(ValueError, match="layer 2 vanished"):
        layered(z, parts, plan=Plan(((), (step,))), filling=FILLING)


def test_layers_must_be_those_of_the_exemplars() -> None:
    z = dots()
    one = torch.zeros(48, 48, dtype=torch.long)
    with pytest.raises(ValueError, match="one layer only"):
        layered(z, [Segmentation(one, one)])
    with pytest.raises(ValueError, match="2 given for 1"):
        layered(z, [segment(z, 2)] * 2)
    with pytest.raises(ValueError, match="segmentation is 48x48"):
        layered(z[:, 2:], [segment(z, 2)])


# --------------------------------------------------------------------------------- designs


@pytest.mark.parametrize("enlarge", ["graphcut", "layers"])
@pytest.mark.parametrize("overlap", [None, 12])
@pytest.mark.parametrize("spread", [None, Spread(rotate=(20.0, 40.0), mirror=1.0)])
def test_designs_are_read_from_the_exemplars(
    enlarge: Enlarge, overlap: int | None, spread: Spread | None
) -> None:
    zs = [dots(seed=1), dots(side=40, seed=2)]
    made = design(
        zs, (60, 56), layering=QUICK, spread=spread, textures=2, enlarge=enlarge,
        cyclic_overlap=overlap, seed=4,
    )  # fmt: skip
    assert made.texture.shape == (3, 60, 56)
    assert torch.equal(made.apply(zs), made.texture)
    if overlap is not None:
        for axis in (1, 2):
            steps = (made.texture - made.texture.roll(1, axis)).abs().mean((0, 3 - axis))
            assert float(steps[0]) <= float(steps[1:].max())  # no worse than some line inside


def test_wavelets_make_a_design_of_the_set(monkeypatch: pytest.MonkeyPatch) -> None:
    z = dots(1)
    made = design(z, (40, 44), layering=QUICK, textures=2, enlarge="wavelet", seed=1)
    assert made.texture.shape == (1, 40, 44)
    assert made.apply(z).shape == made.texture.shape
    assert 0 <= float(made.texture.min()) <= float(made.texture.max()) <= 1


def test_seeds_differ_and_repeat_whatever_the_threads() -> None:
    z = dots(1)
    both = designs(z, (50, 50), 2, layering=QUICK, textures=1, seed=5, workers=1)
    torch.set_num_threads(2)
    for seed, one in zip((5, 6), both, strict=True):
        other = design(z, (50, 50), layering=QUICK, textures=1, seed=seed)
        assert torch.equal(one.texture, other.texture)
        assert torch.equal(one.field.positions, other.field.positions)
        assert one.seed == other.seed == seed
    assert not torch.equal(both[0].texture, both[1].texture)


@pytest.mark.slow
def test_workers_change_no_bit() -> None:
    z = dots(1)
    alone, shared = (
        designs(z, (50, 50), 3, layering=QUICK, textures=1, workers=workers) for workers in (1, 2)
    )
    for one, other in zip(alone, shared, strict=True):
        assert torch.equal(one.texture, other.texture)


def test_a_plan_is_taken_for_one_texture() -> None:
    z = dots()
    still = replace(QUICK, plans=(Plan(((),) * 5),))
    made = design(z, (48, 48), layering=still, textures=1)
    plain = layered(z, [segment(z, 2)], plan=still.plans[0], filling=FILLING)
    assert torch.equal(plain.texture, z)
    assert torch.equal(made.apply(z), made.texture)


def test_poisson_changes_pixels_and_not_sources() -> None:
    z = dots()
    plain, even = (
        design(z, (56, 56), layering=QUICK, textures=1, poisson=p, cyclic_overlap=10)
        for p in (False, True)
    )
    assert plain.field.positions.shape == even.field.positions.shape
    assert not torch.equal(plain.texture, even.texture)
    assert 0 <= float(even.texture.min()) <= float(even.texture.max()) <= 1


def test_sources_are_carried_through() -> None:
    z = dots(side=40)
    first = whole_deformed([z], 0, Deformation(rotate=90.0), FILLING)
    turned = whole_deformed([first.texture], 0, Deformation(rotate=90.0), FILLING)
    twice = onto(turned, [first], [z], None)
    assert torch.equal(twice.texture, z.flip((1, 2)))
    tilted = whole_deformed([z], 0, Deformation(rotate=30.0), FILLING)
    back = whole_deformed([tilted.texture], 0, Deformation(rotate=-30.0), FILLING)
    whole = onto(back, [tilted], [z], None)
    middle = (slice(None), slice(14, 26), slice(14, 26))
    assert torch.allclose(whole.texture[middle], z[middle], atol=0.02)
    # a place between pixels of unlike sources takes the nearest one
    jumps = copied(torch.tensor([[[0, 3, 3], [0, 30, 9]]]), ((40, 40),))
    part = Montage(z[:, :1, :2], jumps, torch.zeros(1, 2).long(), 0.0, 0, {})
    places = torch.tensor([[[0.0, 0.0, 0.4], [0.0, 0.0, 0.9]]])
    outer = Montage(z[:, :1, :2], copied(places, ((1, 2),)), torch.zeros(1, 2).long(), 0.0, 0, {})
    assert onto(outer, [part], [z], None).field.positions[0, 0].tolist() == [[0, 3, 3], [0, 30, 9]]


def test_steps_are_told_and_may_cancel() -> None:
    told: list[Stage] = []
    z = dots()
    design(z, (60, 60), layering=QUICK, textures=2, cyclic_overlap=8, on_step=told.append)
    assert [stage.done for stage in told] == sorted(stage.done for stage in told)
    assert 0.95 < told[-1].done <= 1
    assert {"layers", "completion", "filling"} <= {stage.note for stage in told}
    told.clear()
    designs(z, (50, 50), 2, layering=QUICK, textures=1, workers=1, on_step=told.append)
    assert [stage.done for stage in told] == sorted(stage.done for stage in told)

    def cancel(_: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        design(z, (60, 60), layering=QUICK, on_step=cancel)


@pytest.mark.usefixtures("unchecked")
def test_bad_input_is_refused() -> None:
    z = dots()
    for options, words in (
        ({"textures": 0}, "textures=0"),
        ({"enlarge": "zoom"}, "enlarge='zoom'"),
        ({"cyclic_overlap": 1}, "cyclic_overlap=1"),
        ({"cyclic_overlap": 50}, "cyclic_overlap=50"),
        ({"seed": -1}, "seed=-1"),
        ({"layering": Layering(layers=1)}, "layers=1 must lie in 2"),
        ({"layering": replace(QUICK, plans=(Plan(()),))}, "plan: 1 given and textures=3"),
        ({"layering": replace(QUICK, chaos=Chaos(), filling=Filling(patch=1))}, "patch=1"),
    ):
        with pytest.raises(ValueError, match=words):
            design(z, (48, 48), **options)
    with pytest.raises(ValueError, match="size=0x5"):
        design(z, (0, 5), layering=QUICK)
    for count, workers in ((0, 1), (2, 0)):
        with pytest.raises(ValueError, match="must be at least 1"):
            designs(z, (48, 48), count, workers=workers)
    assert "wavelet" in ENLARGE
