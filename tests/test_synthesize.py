"""Coarse to fine: reproducible, steerable, honest about what it cannot do."""

import doctest
import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from conftest import noise, spots, stripes
from torch import Tensor

import torchtex
from torchtex import metrics
from torchtex.controls import Guide, SoftConstraint
from torchtex.estep import Descend
from torchtex.features import Gradients, Wavelets
from torchtex.image import read_metadata, resize
from torchtex.matching import Chunked
from torchtex.model import Search, exact_search
from torchtex.result import Checkpoint, Progress, Result
from torchtex.schedule import Level, default_schedule, is_complete
from torchtex.starts import Blocks, RandomNeighborhoods
from torchtex.synthesize import estimate_memory, synthesize

QUICK = (Level(0.5, 8, 2), Level(1.0, 8, 2))


def quick(exemplars: Any, size: tuple[int, int] = (28, 35), **options: Any) -> Result:
    return synthesize(exemplars, size, **{"schedule": QUICK, **options})


# ------------------------------------------------------------------------------ determinism


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"feature": Gradients(), "completeness": 0.0},
        {"feature": Wavelets("db2"), "controls": "pull"},
        {"estep": Descend("lbfgs", 3)},
        {"estep": Descend("adam", 3), "search": exact_search()},
    ],
    ids=str,
)
def test_same_seed_same_bits_for_any_number_of_threads(options: dict[str, Any]) -> None:
    size = (112, 104)  # large enough that torch shares the work out
    z = stripes(40, 44).float()
    if options.get("controls") == "pull":
        pull = SoftConstraint(torch.ones(3, *size) / 2, noise(*size).float())
        options = {**options, "controls": [(0.3, pull)]}
    runs = []
    for count in (1, 2, 1):
        torch.set_num_threads(count)
        runs.append(synthesize(z, size, seed=3, schedule=(Level(0.5, 8, 1), Level(1.0, 8, 1)),
                               **options))  # fmt: skip
    assert torch.get_num_threads() == 1
    for run in runs[1:]:
        assert torch.equal(run.texture, runs[0].texture)
        assert torch.equal(run.labels, runs[0].labels)


def test_another_seed_is_another_texture_and_the_global_state_is_left_alone() -> None:
    z = stripes(32, 32)
    torch.manual_seed(5)
    state = torch.get_rng_state()
    first, second, third = (quick(z, seed=seed).texture for seed in (0, 1, 0))
    assert torch.equal(state, torch.get_rng_state())
    assert torch.equal(first, third)
    assert (first - second).abs().mean() > 0.02


# --------------------------------------------------------------------------------- pictures


@pytest.mark.parametrize("channels", [1, 2, 5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("boundary", ["free", "periodic"])
def test_any_number_of_channels(channels: int, dtype: torch.dtype, boundary: str) -> None:
    z = stripes(30, 33, channels).to(dtype)
    before = z.clone()
    result = quick(z, boundary=boundary)
    assert result.texture.shape == (channels, 28, 35)
    assert result.texture.dtype == dtype
    assert result.texture.min() >= 0
    assert result.texture.max() <= 1
    assert torch.equal(z, before)
    torch.testing.assert_close(result.apply(z), result.texture, rtol=0, atol=1e-7)
    if dtype == torch.float64:
        assert torch.equal(result.apply(z), result.texture)


def test_a_texture_is_closer_to_its_exemplar_than_a_plain_baseline() -> None:
    z = stripes(40, 40)
    result = synthesize(z, (48, 48))
    pixels = z.flatten(1)
    pick = torch.randint(pixels.shape[1], (48 * 48,), generator=torch.Generator().manual_seed(0))
    shuffled = pixels[:, pick].view(3, 48, 48)
    assert metrics.nn(result.texture, z) < 0.3 * metrics.nn(shuffled, z)
    assert metrics.swd(result.texture, z) < 0.5 * metrics.swd(shuffled, z)


def test_a_periodic_texture_has_no_seam_where_it_wraps() -> None:
    z = stripes(40, 40, 1)
    free, periodic = (quick(z, (32, 36), boundary=b).texture for b in ("free", "periodic"))

    def jump(x: Tensor) -> float:
        across = (x[:, 0] - x[:, -1]).abs().mean() + (x[:, :, 0] - x[:, :, -1]).abs().mean()
        inside = x.diff(dim=1).abs().mean() + x.diff(dim=2).abs().mean()
        return float(across / inside)

    assert jump(periodic) < 1.5
    assert jump(periodic) < jump(free)


def test_completeness_keeps_a_rare_motif() -> None:
    z = spots(48)
    schedule = (Level(0.5, 8, 4), Level(1.0, 8, 2))
    lost, kept = [], []
    for seed in range(3):
        options = {"schedule": schedule, "seed": seed}
        plain = quick(z, (64, 64), completeness=0.0, start=RandomNeighborhoods(), **options)
        full = quick(z, (64, 64), **options)
        lost.append(metrics.miss(plain.texture, z))
        kept.append(metrics.miss(full.texture, z))
    assert sum(kept) < sum(lost)


@pytest.mark.parametrize("feature", [None, Gradients(), Wavelets("db2"), Wavelets(mode="window")])
@pytest.mark.parametrize("boundary", ["free", "periodic"])
def test_energies_of_the_papers_algorithm_never_increase(feature: Any, boundary: str) -> None:
    result = quick(stripes(30, 33), feature=feature, completeness=0.0, boundary=boundary)
    assert len(result.traces) == 2
    for trace in result.traces:
        assert all(after <= before * (1 + 1e-9) for before, after in pairwise(trace.energies))
    assert len(result.energies) == sum(len(trace.energies) for trace in result.traces)


def test_any_callable_is_a_feature() -> None:
    def contrast(image: Tensor) -> Tensor:
        return torch.cat([image, (image - image.mean()).square()])

    assert quick(stripes(30, 33), feature=contrast).texture.shape == (3, 28, 35)


def test_offsets_and_sources_point_at_the_colours() -> None:
    z = noise(1, 24, 30)
    result = quick(z)
    ny, nx = result.field.grid.shape
    assert result.offsets.shape == (ny, nx, 2)
    assert len(result.labels) == ny * nx
    source = result.source_map
    assert source.shape == (28, 35, 3)
    assert (source[..., 0] == 0).all()
    copied = z[:, source[..., 1], source[..., 2]]
    assert (copied - result.texture).abs().mean() < 0.5 * (z.mean() - result.texture).abs().mean()


# ---------------------------------------------------------------------------- start, schedule


def test_init_is_where_it_starts() -> None:
    z = stripes(32, 32)
    wanted = z[:, 2:30, 1:29].contiguous()
    result = quick(z, (28, 28), init=wanted, completeness=0.0, search=exact_search())
    assert (result.texture - wanted).abs().mean() < 0.05
    other = quick(z, (28, 28), init=F.interpolate(wanted[None], (13, 17))[0])
    assert other.texture.shape == (3, 28, 28)
    assert other.settings["start"] == "init"


@pytest.mark.parametrize("start", [Blocks(), Blocks(0.2), Blocks(1.0), RandomNeighborhoods()])
def test_starts_show_only_what_the_masks_allow(start: Any) -> None:
    z = torch.cat([noise(1, 20, 24), torch.zeros(1, 20, 24, dtype=torch.float64)])
    mask = torch.ones(20, 24, dtype=torch.bool)
    mask[:, 13:] = False
    z[1, ~mask] = 1
    grid = torchtex.Grid(25, 31, 8, 4)
    x = start([z], [mask], grid, torch.Generator().manual_seed(0))
    assert x.shape == (2, 25, 31)
    assert x[1].abs().max() == 0
    again = start([z], [mask], grid, torch.Generator().manual_seed(0))
    assert torch.equal(x, again)


def test_blocks_are_verbatim() -> None:
    z = noise(1, 20, 20)
    x = Blocks()([z], [None], torchtex.Grid(25, 20, 8, 4), torch.Generator().manual_seed(0))
    assert torch.isin(x, z).all()


def test_levels_that_do_not_fit_are_left_out() -> None:
    z = stripes(20, 40)
    every = synthesize(z, (40, 40), schedule=default_schedule()).traces
    assert [trace.level.size for trace in every] == [8, 16, 8]
    roomy = synthesize(z, (40, 40)).traces  # windows larger than half the exemplar are left out
    assert [trace.level.size for trace in roomy] == [8]
    small = synthesize(stripes(40, 40), (9, 40)).traces
    assert [trace.level.size for trace in small] == [8]


@pytest.mark.parametrize("size", [(8, 8), (9, 61), (33, 17)])
def test_odd_sizes(size: tuple[int, int]) -> None:
    schedule = (Level(0.3, 4, 1), Level(0.61, 5, 1, stride=2), Level(1.0, 7, 1, stride=3))
    for boundary in ("free", "periodic"):
        result = quick(stripes(31, 26, 1), size, schedule=schedule, boundary=boundary)
        assert result.texture.shape == (1, *size)
        assert result.texture.isfinite().all()


def test_a_scale_may_begin_with_enlarged_pixels() -> None:
    z = stripes(30, 33)
    plain, carried = quick(z, carry=False), quick(z)
    assert plain.texture.shape == carried.texture.shape
    assert torch.equal(plain.traces[0].snapshot, carried.traces[0].snapshot)
    assert not torch.equal(plain.texture, carried.texture)
    torch.testing.assert_close(plain.apply(z), plain.texture)


def test_the_default_schedule_may_be_shortened() -> None:
    assert {level.steps for level in default_schedule(1)} == {1}
    assert default_schedule()[-1].scale == 1


def test_flat_exemplars_stay_flat() -> None:
    for value in (0.0, 0.25, 1.0):
        for feature in (None, Gradients(), Wavelets()):
            z = torch.full((1, 24, 24), value, dtype=torch.float64)
            texture = quick(z, feature=feature).texture
            torch.testing.assert_close(texture, torch.full_like(texture, value))


# -------------------------------------------------------------------------------- exemplars


def test_several_exemplars_are_all_used() -> None:
    dark, bright = 0.3 * stripes(24, 30), 0.7 + 0.3 * stripes(33, 21, seed=1)
    result = quick([dark, bright], (48, 48))
    share = (result.source_map[..., 0] == 1).double().mean()
    assert 0.05 < share < 0.95
    torch.testing.assert_close(result.apply([dark, bright]), result.texture)
    rendered = result.apply([torch.zeros(1, 24, 30), torch.ones(1, 33, 21)])
    assert rendered.shape == (1, 48, 48)


def test_masked_pixels_are_never_shown() -> None:
    z, mask = 0.5 * stripes(40, 40), torch.ones(40, 40, dtype=torch.bool)
    mask[:18, :15] = False
    result = quick(z, masks=mask)
    assert result.apply((~mask).double()[None]).max() == 0
    result = quick([z, z], masks=[mask, None])
    assert result.apply([(~mask).double()[None], torch.zeros(1, 40, 40).double()]).max() == 0


# ---------------------------------------------------------------------------------- controls


def test_the_palette_energy_of_the_readme() -> None:
    generator = torch.Generator().manual_seed(0)
    directions = F.normalize(torch.randn(16, 3, generator=generator), dim=1).double()
    wanted = torch.tensor([[0.9, 0.8], [0.2, 0.3], [0.1, 0.1]], dtype=torch.float64)

    def palette(x: Tensor) -> Tensor:
        ours = (directions @ x.flatten(1)).sort(dim=1).values
        rank = torch.linspace(0, 1, ours.shape[1], dtype=x.dtype)
        theirs = torch.quantile(directions @ wanted, rank, dim=1).T
        return (ours - theirs).square().sum()

    z = stripes(32, 32)
    plain, steered = quick(z), quick(z, controls=[(1.0, palette)])
    assert palette(steered.texture) < 0.5 * palette(plain.texture)


def test_a_soft_constraint_pulls_where_it_holds() -> None:
    z = stripes(32, 32, 1)
    z[:, :, 16:] = 0.9 * z[:, :, 16:] + 0.1
    target = torch.full((1, 28, 35), 0.9, dtype=torch.float64)
    full = torch.ones(28, 35, dtype=torch.float64)
    half = full.clone()
    half[:, 17:] = 0
    plain = quick(z).texture
    pulled = quick(z, controls=[(5.0, SoftConstraint(target, full))]).texture
    beside = quick(z, controls=[(5.0, SoftConstraint(target, half))]).texture

    def gap(x: Tensor) -> Tensor:
        return (x - target).abs().mean((0, 1))

    assert gap(pulled).mean() < 0.6 * gap(plain).mean()
    assert gap(beside)[:14].mean() < 0.6 * gap(plain)[:14].mean()
    assert gap(beside)[24:].mean() > 0.7 * gap(plain)[24:].mean()


def test_a_soft_constraint_of_another_dtype_or_size_is_adapted() -> None:
    z = stripes(32, 32, 1).float()
    pull = SoftConstraint(noise(1, 14, 17), noise(14, 17))
    for feature in (None, Gradients()):
        result = quick(z, controls=[(1.0, pull)], feature=feature)
        assert result.texture.dtype == torch.float32


def test_a_guide_says_what_goes_where() -> None:
    z = stripes(32, 40, 1) * 0.3
    z[:, :, 20:] += 0.6
    side = torch.zeros(1, 32, 40, dtype=torch.float64)
    side[:, :, 20:] = 1
    plan = torch.zeros(1, 28, 35, dtype=torch.float64)
    plan[:, 14:] = 1
    result = quick(z, guides=[Guide([side], plan, 5.0)])
    assert result.texture[:, :10].mean() < 0.3
    assert result.texture[:, 18:].mean() > 0.6
    guided = quick(z, guides=[Guide([side.float()], plan.float(), 5.0)], feature=Gradients())
    assert guided.texture[:, :10].mean() < guided.texture[:, 18:].mean() - 0.3


# ---------------------------------------------------------------------------------- progress


def test_progress_rises_to_the_end() -> None:
    seen: list[Progress] = []
    quick(stripes(30, 30), on_step=seen.append)
    done = [step.done for step in seen]
    assert done == sorted(set(done))
    assert done[0] > 0
    assert 0.8 < done[-1] <= 1
    assert {step.level for step in seen} == {0, 1}
    assert all(step.levels == 2 for step in seen)
    assert seen[-1].half.texture.shape == (3, 28, 35)


def test_raising_from_on_step_cancels() -> None:
    count = 0

    def stop(step: Progress) -> None:
        nonlocal count
        count += 1
        if count == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        quick(stripes(30, 30), on_step=stop)
    assert count == 2


# ------------------------------------------------------------------------------------ result


def test_a_result_is_saved_with_its_settings(tmp_path: Path) -> None:
    result = quick(stripes(30, 30), seed=4)
    result.save(tmp_path / "t.png")
    report = json.loads(read_metadata(tmp_path / "t.png")["torchtex"])
    assert report == json.loads(json.dumps(result.report()))
    assert report["seed"] == 4
    assert report["settings"]["size"] == [28, 35]
    assert [level["size"] for level in report["levels"]] == [8, 8]
    result.field.save(tmp_path / "t.npz")
    back = torchtex.LabelField.load(tmp_path / "t.npz")
    assert torch.equal(back.apply(stripes(30, 30)), result.field.apply(stripes(30, 30)))


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_plot_draws_the_curve_and_every_level(channels: int) -> None:
    pytest.importorskip("matplotlib")
    result = quick(stripes(30, 30, channels))
    figure = result.plot()
    assert len(figure.axes) == 1 + len(result.traces)
    drawn = [y for line in figure.axes[0].lines for y in line.get_ydata()]
    assert tuple(drawn) == pytest.approx(result.energies)
    figure.canvas.draw()


def test_gradients_of_the_exemplar_are_not_followed() -> None:
    assert not quick(stripes(30, 30).requires_grad_()).texture.requires_grad


# ------------------------------------------------------------------------------------ errors

Z = stripes(30, 30)
MASK = torch.zeros(30, 30, dtype=torch.bool)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: quick([]), "exemplar: none given"),
        (lambda: quick(Z[0]), "exemplar has shape"),
        (lambda: quick(Z / 0), "exemplar holds NaN or infinity"),
        (lambda: quick([Z, Z[:1]]), "one has 3 channels and another 1"),
        (lambda: quick(Z, (0, 20)), "size=0x20 must be at least 1x1"),
        (lambda: quick(Z, (10**6, 10**6)), "size=1000000x1000000 would need about .* GiB"),
        (lambda: quick(Z, boundary="torus"), 'boundary="torus" must be "free" or "periodic"'),
        (lambda: quick(Z, r=0.0), r"r=0.0 must lie in \(0, 2\]"),
        (lambda: quick(Z, completeness=-1.0), "completeness=-1.0 must be at least 0"),
        (
            lambda: quick(Z, completeness=-1.0, schedule=(Level(1.0, 8, 1),)),
            "completeness=-1.0 must be at least 0",
        ),
        (lambda: quick(Z, masks=MASK), "mask is empty"),
        (lambda: quick(Z, masks=~MASK[:20]), "mask is 20x30 and its exemplar 30x30"),
        (lambda: quick([Z, Z], masks=[~MASK]), "mask: 1 given for 2 exemplars"),
        (lambda: quick(Z, init=Z[:1]), "init has 1 channels and exemplar 3"),
        (lambda: quick(Z, init=Z / 0), "init holds NaN"),
        (lambda: quick(Z[:, :7]), "exemplar of 7x30 for size=28x35: no window .* fits"),
        (lambda: quick(Z, (7, 40)), "no window of the schedule fits"),
        (lambda: quick(Z, schedule=(Level(0.5, 8, 1),)), "schedule ends with scale=0.5"),
        (lambda: quick(Z, schedule=(Level(0.5, 8, 1), Level(1.0, 32, 1))), "no window .* scale=1"),
        (
            lambda: quick(Z, schedule=(Level(1.0, 8, 1, stride=9),)),
            r"stride=9 must lie in 1\.\.size=8",
        ),
        (lambda: quick(Z, guides=[Guide([], Z)]), "guide of the exemplars: none given"),
        (lambda: quick(Z, guides=[Guide([Z[:, :9]], Z)]), "9x30 given for exemplars of 30x30"),
        (
            lambda: quick(Z, controls=[(1.0, SoftConstraint(Z[:1], Z[0]))]),
            "target of a soft constraint has 1 channels and exemplar 3",
        ),
        (lambda: Level(0.0, 8, 1), r"scale=0.0 of a level must lie in \(0, 1\]"),
        (lambda: Level(1.5, 8, 1), "scale=1.5"),
        (lambda: Level(1.0, 1, 1), "size=1 of a level's windows must be at least 2"),
        (lambda: Level(1.0, 8, 0), "steps=0 of a level must be at least 1"),
        (lambda: Blocks(0.0), "fraction=0.0 of blocks"),
        (lambda: quick(Z, feature=Wavelets(mode="window"), schedule=(Level(1.0, 7, 1),)), "size=7"),
    ],
)
def test_bad_input_gets_one_clear_sentence(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("unchecked")
def test_integers_and_mixed_types_are_refused() -> None:
    with pytest.raises(TypeError, match=r"exemplar is torch.uint8"):
        quick((255 * Z).byte())
    with pytest.raises(TypeError, match="give all as float32 or all as float64"):
        quick([Z, Z.float()])
    with pytest.raises(TypeError, match=r"torch.float16"):
        quick(Z.half())


def test_memory_grows_with_the_texture() -> None:
    small, large = (estimate_memory([(64, 64)], (side, side), 3) for side in (64, 4096))
    assert 2**20 < small < large < 2**34


def test_the_examples_run() -> None:
    import sys

    assert doctest.testmod(sys.modules["torchtex.synthesize"]).failed == 0


# ------------------------------------------------------------------------------ going on


@pytest.mark.parametrize("options", [{}, {"feature": Gradients()}, {"carry": False}, {"seed": 3}])
def test_a_run_goes_on_from_a_checkpoint_with_the_same_bits(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    kept: list[Checkpoint] = []
    schedule = (*QUICK, Level(1.0, 6, 1))
    whole = quick(stripes(), schedule=schedule, on_level=kept.append, **options)
    assert [len(one.traces) for one in kept] == [1, 2, 3]
    for one in kept:
        one.save(tmp_path / "c.npz")
        seen: list[Progress] = []
        again = quick(
            stripes(),
            schedule=schedule,
            resume=Checkpoint.load(tmp_path / "c.npz"),
            on_step=seen.append,
            **options,
        )
        assert torch.equal(again.texture, whole.texture)
        assert torch.equal(again.labels, whole.labels)
        assert again.energies == whole.energies
        assert {step.level for step in seen} == set(range(len(one.traces), 3))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("seed", {"seed": 4}),
        ("r", {"r": 1.0}),
        ("schedule", {"schedule": QUICK[1:]}),
        ("size", {"size": (28, 36)}),
        ("exemplars", {"exemplars": stripes(seed=5)}),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(name: str, options: dict[str, Any]) -> None:
    kept: list[Checkpoint] = []
    quick(stripes(), on_level=kept.append)
    given = {"exemplars": stripes(), **options}
    with pytest.raises(ValueError, match=f"resume: the checkpoint is of a run with {name}="):
        quick(resume=kept[0], **given)


def test_a_file_that_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    (tmp_path / "c.npz").write_bytes(b"no")
    with pytest.raises(ValueError, match=r"checkpoint=.* is not a checkpoint"):
        Checkpoint.load(tmp_path / "c.npz")
    with pytest.raises(ValueError, match="no level is done"):
        Checkpoint(0, {}, torch.zeros(1)).save(tmp_path / "d.npz")


def test_settings_name_all_that_decides_the_pixels() -> None:
    run = quick(stripes(), controls=[(0.5, SoftConstraint(noise(3, 28, 35), torch.ones(28, 35)))])
    assert {"schedule", "estep", "controls", "guides", "masks", "exemplars"} <= set(run.settings)
    assert run.settings["controls"] == [[0.5, "SoftConstraint"]]
    json.dumps(dict(run.settings))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"search": Search(Chunked())},
        {"boundary": "periodic", "start": RandomNeighborhoods()},
        {"feature": Wavelets("haar")},
        {"masks": torch.ones(32, 32, dtype=torch.bool)},
    ],
)
def test_a_run_on_an_accelerator_stays_there(options: dict[str, Any]) -> None:
    given = {k: v.cuda() if isinstance(v, torch.Tensor) else v for k, v in options.items()}
    run = quick(stripes().float().cuda(), schedule=(*QUICK, Level(1.0, 6, 1)), **given)
    assert run.texture.is_cuda
    assert run.labels.is_cuda
    close = metrics.swd(run.texture.cpu(), stripes().float())
    assert close < 2 * metrics.swd(quick(stripes().float(), **options).texture, stripes().float())


def test_a_level_says_whether_it_is_complete() -> None:
    z = stripes(32, 32)
    fine, coarse = Level(1.0, 8, 2), Level(0.5, 6, 2)
    grid = fine.grid(40, 40, False)
    assert not is_complete(fine, grid, [z])
    assert is_complete(coarse, coarse.grid(40, 40, False), [resize(z, (16, 16))])
    assert is_complete(replace(fine, complete=True), grid, [z])
    assert not is_complete(replace(coarse, complete=False), grid, [z])
    one, other = (
        synthesize(z, (40, 40), schedule=[coarse, replace(fine, complete=complete)], seed=1)
        for complete in (None, True)
    )
    assert not torch.equal(one.texture, other.texture)
    assert other.settings["schedule"][1]["complete"] is True
