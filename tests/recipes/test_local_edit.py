"""Local edits: what a stroke forces and leaves open, whole objects, exact sources."""

import sys
from collections.abc import Callable

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex.cuts.mincut import MinCut, OrTools, PyMaxflow
from torchtex.recipes.local_edit import Objects, edit
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.strokes import Stroke, brush

SIZE = (56, 60)
DOT = brush(SIZE, [(20.0, 20.0)], 4.0)


def disk(row: float, col: float, radius: float, size: tuple[int, int] = SIZE) -> Tensor:
    return brush(size, [(row, col)], radius)


def meadow(flower: Tensor | None = None, seed: int = 0) -> Tensor:
    """Green grain, and a flower on it: red with a yellow rim."""
    ground = torch.tensor([0.2, 0.5, 0.2], dtype=torch.float64)[:, None, None]
    image = ground + 0.2 * (noise(3, *SIZE, seed=seed) - 0.5)
    if flower is not None:
        row, col = flower.nonzero().double().mean(0)
        heart = disk(float(row), float(col), 3.0)
        image[:, flower] = torch.tensor([0.9, 0.8, 0.1], dtype=torch.float64)[:, None]
        image[:, heart] = torch.tensor([0.6, 0.1, 0.1], dtype=torch.float64)[:, None]
    return image


def pile() -> tuple[Tensor, Tensor]:
    """Olives of one colour that touch, each shaded and with a dark gap around; and their numbers.

    Wherever one is put, its inside agrees with the insides of those below.
    """
    row, col = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in SIZE), indexing="ij")
    shift = 6.5 * (row // 13 % 2)
    apart = ((row % 13 - 6) ** 2 + ((col + shift) % 13 - 6) ** 2).sqrt()
    shade = torch.where(apart <= 5.7, 0.75 - 0.01 * apart, 0.1)
    which = (row // 13) * 10 + (col + shift) // 13
    image = shade * torch.tensor([0.8, 0.8, 0.3], dtype=torch.float64)[:, None, None]
    grain = 0.02 * (noise(3, *SIZE) - 0.5)
    return (image + grain).clamp(0, 1), torch.where(apart <= 5.7, which, -1)


# ------------------------------------------------------------------------- whole objects


@pytest.mark.parametrize("blob", [(20.0, 20.0, 5.0), (18.0, 22.0, 5.0), (22.0, 18.0, 5.0)])
def test_a_rough_dab_takes_the_whole_flower(blob: tuple[float, float, float]) -> None:
    flower = disk(20.0, 20.0, 8.0)
    reference, base = meadow(flower), meadow(seed=1)
    result = edit(base, [Stroke(disk(*blob), (15, 20))], reference=reference, poisson=False)
    moved = flower.roll((15, 20), (0, 1))
    # no petal is cut off, but for single pixels at its poles
    assert float((result.patches[moved] == 1).double().mean()) > 0.97
    assert int(result.patches.sum()) < 1.6 * int(flower.sum())


def test_a_dab_that_spills_over_is_cut_back_to_the_object() -> None:
    image, which = pile()
    number = which[19, 26]
    spilled = brush(SIZE, [(18.0, 26.0), (21.5, 28.0)], 4.2)
    assert bool((which[spilled] != number).any())
    result = edit(image, [Stroke(spilled, (20, 3))], poisson=False)
    places = result.source_map[result.patches == 1]
    taken = which[places[:, 1], places[:, 2]]
    wanted = int((which == number).sum())
    assert int((taken == number).sum()) > 0.97 * wanted
    assert int(((taken != number) & (taken >= 0)).sum()) < 0.05 * wanted


def taken_of(result: Montage, which: Tensor, number: int) -> tuple[float, float]:
    """Share of an object that was taken, and pixels of others in units of it."""
    places = result.source_map[result.patches == 1]
    taken = which[places[:, 1], places[:, 2]]
    whole = int((which == number).sum())
    return int((taken == number).sum()) / whole, int(
        ((taken != number) & (taken >= 0)).sum()
    ) / whole


def test_alike_things_that_touch_are_cut_by_the_paper_and_kept_whole_by_us() -> None:
    image, which = pile()
    number = int(which[19, 26])
    stroke = Stroke(disk(19.0, 25.0, 3.0), (20, 3))
    ours, spill = taken_of(edit(image, [stroke], poisson=False), which, number)
    papers, _ = taken_of(edit(image, [stroke], poisson=False, objects=None), which, number)
    assert ours > 0.97
    assert spill < 0.05
    assert papers < 0.9


def test_an_airbrush_takes_the_whole_of_one_thing() -> None:
    image, which = pile()
    row, col = torch.meshgrid(*(torch.arange(n) for n in SIZE), indexing="ij")
    spray = torch.exp(-((row - 20) ** 2 + (col - 25) ** 2) / 32.0)  # nowhere 0
    result = edit(image, [Stroke(spray, (20, 3))], poisson=False)
    ours, spill = taken_of(result, which, int(which[19, 26]))
    assert ours > 0.97
    assert spill < 0.05


def test_large_differences_at_the_seam_do_not_bleed() -> None:
    flower = disk(20.0, 20.0, 8.0)
    reference = meadow(flower)
    base = meadow(seed=1)
    base[:, :, 40:] = 0.95  # a white wall, half behind the flower
    stroke = Stroke(disk(20.0, 20.0, 6.0), (15, 20))
    moved = flower.roll((15, 20), (0, 1))
    plain = edit(base, [stroke], reference=reference, poisson=False).texture
    ours = edit(base, [stroke], reference=reference).texture
    papers = edit(base, [stroke], reference=reference, objects=None).texture
    assert float((ours - plain)[:, moved].abs().mean()) < 0.02
    assert float((papers - plain)[:, moved].abs().mean()) > 0.05


# ---------------------------------------------------------------- what is forced and free


def test_the_core_shows_the_reference_and_far_pixels_the_base() -> None:
    base, reference = noise(3, *SIZE), noise(3, *SIZE, seed=1)
    stroke = Stroke(DOT, (10, 12))
    objects = Objects(doubt=0.0)
    result = edit(base, [stroke], reference=reference, band=5, poisson=False, objects=objects)
    moved = DOT.roll((10, 12), (0, 1))
    assert bool((result.patches[moved] == 1).all())
    far = ~disk(30.0, 32.0, 4.0 + 5.0 + 0.5)
    assert not bool(result.patches[far].any())
    assert torch.equal(result.texture[:, far], base[:, far])
    assert torch.equal(
        result.texture[:, moved], reference.roll((10, 12), (1, 2))[:, moved]
    )  # the pixels themselves


def test_grey_paint_is_left_to_the_cut() -> None:
    image = noise(3, *SIZE)
    image[:, 30:, :] = image[:, 10:36, :]  # rows 20 lower agree: nothing is gained by a seam
    soft = 0.4 * disk(20.0, 20.0, 9.0).double()
    soft[DOT] = 1.0
    reference = noise(3, *SIZE, seed=1)
    result = edit(image, [Stroke(soft, (12, 12))], reference=reference, band=1, objects=None)
    shown = int(result.patches.sum())
    assert int(DOT.sum()) <= shown < int((soft > 0).sum())


def test_the_rim_of_a_mark_is_open_by_doubt() -> None:
    base, reference = noise(3, *SIZE), noise(3, *SIZE, seed=1)
    base[:, 26:35, 28:37] = reference[:, 16:25, 16:25]  # a square in the mark agrees
    stroke = Stroke(disk(20.0, 20.0, 8.0), (10, 12))

    def shown(doubt: float) -> int:
        objects = Objects(doubt=doubt, whole=0.0, outline=0.0, length=0.0)
        result = edit(base, [stroke], reference=reference, objects=objects, poisson=False)
        return int(result.patches.sum())

    assert shown(0.5) < int(disk(20.0, 20.0, 8.0).sum()) <= shown(0.0)


def test_what_the_reference_may_not_show_stays_out() -> None:
    base, reference = noise(3, *SIZE), noise(3, *SIZE, seed=1)
    allowed = torch.ones(SIZE, dtype=torch.bool)
    allowed[:, 22:] = False
    result = edit(
        base, [Stroke(DOT, (10, 12))], reference=reference, reference_mask=allowed, poisson=False
    )
    assert not bool(result.patches[:, 34:].any())
    assert bool(result.patches[30, 33])


def test_a_low_data_cost_lets_the_base_win() -> None:
    base, reference = noise(3, *SIZE), noise(3, *SIZE, seed=1)
    stroke = Stroke(DOT, (10, 12))
    assert int(edit(base, [stroke], reference=reference, data_cost=1e-6).patches.sum()) == 0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_no_single_pixel_lowers_the_energy_of_the_paper(seed: int) -> None:
    base, reference = noise(3, *SIZE, seed=seed), noise(3, *SIZE, seed=seed + 10)
    stroke = Stroke(DOT, (10, 12))
    k1, k2 = 0.7, 0.2
    result = edit(
        base, [stroke], reference=reference, k1=k1, k2=k2, band=4, poisson=False, objects=None
    )
    moved = reference.roll((10, 12), (1, 2))

    def slopes(x: Tensor) -> Tensor:
        return torch.cat(torch.gradient(x, dim=(1, 2)))

    apart = k1 * (base - moved).norm(dim=0) + k2 * (slopes(base) - slopes(moved)).norm(dim=0)

    def energy(labels: Tensor) -> float:
        across = (labels[:, 1:] != labels[:, :-1]) * (apart[:, 1:] + apart[:, :-1])
        down = (labels[1:] != labels[:-1]) * (apart[1:] + apart[:-1])
        return float(across.sum() + down.sum())

    labels = result.patches.bool()
    best = energy(labels)
    free = disk(30.0, 32.0, 8.0) & ~disk(30.0, 32.0, 4.0)
    free &= brush(SIZE, [(30.0, 32.0)], 7.9)
    for row, col in free.nonzero().tolist():
        other = labels.clone()
        other[row, col] ^= True
        assert energy(other) >= best - 1e-9
    core = disk(30.0, 32.0, 4.0)
    assert best <= energy(core) + 1e-9


# --------------------------------------------------------------------------------- sources

TURNS = [
    {},
    {"rotation": 90.0},
    {"rotation": 180.0},
    {"mirror": True},
    {"rotation": -90.0, "mirror": True},
    {"rotation": 30.0},
    {"scale": 1.4},
    {"rotation": 200.0, "scale": 0.7, "mirror": True},
]


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("channels", [1, 3, 7])
def test_sources_render_the_texture_exactly(turn: dict[str, float], channels: int) -> None:
    base, reference = noise(channels, 40, 44), noise(channels, *SIZE, seed=1)
    result = edit(base, [Stroke(DOT, (4, 3), **turn)], reference=reference, poisson=False)
    assert torch.equal(result.apply([base, reference]), result.texture)
    assert result.texture.dtype == base.dtype
    maps = [noise(2, 40, 44, seed=5), noise(2, *SIZE, seed=6)]
    assert result.apply(maps).shape == (2, 40, 44)
    whole = set(turn) <= {"rotation", "mirror"} and turn.get("rotation", 0.0) % 90 == 0
    assert result.field.positions.is_floating_point() != whole


@pytest.mark.parametrize(
    ("turn", "place"),
    [
        ({}, (20, 24)),
        ({"rotation": 90.0}, (16, 20)),  # counter-clockwise: what was to the right is above
        ({"rotation": 180.0}, (20, 16)),
        ({"mirror": True}, (20, 16)),
        ({"mirror": True, "rotation": 90.0}, (24, 20)),
        ({"scale": 2.0}, (20, 28)),
    ],
)
def test_marks_turn_counter_clockwise_about_their_middle(
    turn: dict[str, float], place: tuple[int, int]
) -> None:
    reference = noise(1, *SIZE)
    stroke = Stroke(disk(20.0, 20.0, 6.0), (5, 7), **turn)
    result = edit(noise(1, *SIZE, seed=1), [stroke], reference=reference, poisson=False)
    assert result.source_map[place[0] + 5, place[1] + 7].tolist() == [1, 20, 24]


def test_strokes_follow_each_other_and_the_reference_stays_what_it_was() -> None:
    base = noise(3, *SIZE)
    strokes = [
        Stroke(DOT, (12, 20)),
        Stroke(disk(32.0, 40.0, 4.0), (-10, 10), rotation=45.0),
        Stroke(DOT, (14, 21)),
    ]
    result = edit(base, strokes, poisson=False)
    assert result.patches.unique().tolist() == [0, 1, 2, 3]
    assert torch.equal(result.apply(base), result.texture)
    assert result.source_map[22, 50].tolist() == [0, 32, 40]  # not what stroke 1 put there
    assert result.source_map[34, 41].tolist() == [0, 20, 20]
    assert bool(result.seams.any())
    assert result.seam_picture().shape == (3, *SIZE)


def test_a_mark_may_reach_over_the_border() -> None:
    base = noise(3, *SIZE)
    stroke = Stroke(disk(2.0, 2.0, 5.0), (50, 54))
    result = edit(base, [stroke])
    assert bool(result.patches[52, 56])
    assert bool(result.texture.isfinite().all())
    covered = edit(base, [Stroke(torch.ones(SIZE), (0, 0))], reference=noise(3, *SIZE, seed=1))
    assert bool(covered.patches[5:-5, 5:-5].all())


# --------------------------------------------------------------------------------- Poisson


def test_poisson_takes_the_colours_of_the_base() -> None:
    base = 0.2 + 0.3 * noise(3, *SIZE)
    reference = (base + 0.1).roll((-10, -12), (1, 2))
    stroke = Stroke(DOT, (10, 12))
    plain = edit(base, [stroke], reference=reference, poisson=False, objects=None)
    papers = edit(base, [stroke], reference=reference, objects=None)
    ours = edit(base, [stroke], reference=reference)
    assert torch.allclose(papers.texture, base, atol=1e-6)
    error = float((plain.texture - base).abs().sum())
    assert float((ours.texture - base).abs().sum()) < 0.8 * error
    assert 0 <= float(papers.texture.min()) <= float(papers.texture.max()) <= 1


def test_single_precision_stays_so() -> None:
    base = noise(3, *SIZE, dtype=torch.float32)
    result = edit(base, [Stroke(DOT, (10, 12), rotation=10.0)])
    assert result.texture.dtype == torch.float32


# ------------------------------------------------------------------------ runs and solvers


@pytest.mark.parametrize("objects", [None, Objects()])
def test_solvers_agree(objects: Objects | None) -> None:
    solvers: list[MinCut] = [PyMaxflow(), OrTools()]
    first, second = (
        edit(noise(3, *SIZE), [Stroke(DOT, (10, 12))], objects=objects, solver=solver).patches
        for solver in solvers
    )
    assert torch.equal(first, second)


def test_threads_do_not_change_the_bits() -> None:
    base = meadow(disk(20.0, 20.0, 8.0))
    found = []
    for count in (1, 2):
        torch.set_num_threads(count)
        found.append(edit(base, [Stroke(DOT, (12, 20), rotation=20.0)]))
    assert torch.equal(found[0].texture, found[1].texture)
    assert torch.equal(found[0].patches, found[1].patches)


def test_on_step_sees_every_stroke_and_may_stop() -> None:
    stages: list[Stage] = []
    strokes = [Stroke(DOT, (10, 12)), Stroke(DOT, (20, 12))]
    result = edit(noise(3, *SIZE), strokes, on_step=stages.append)
    assert [stage.done for stage in stages] == [0.5, 1.0]
    assert torch.equal(stages[-1].texture, result.texture)
    assert not torch.equal(stages[0].texture, result.texture)

    def stop(stage: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        edit(noise(3, *SIZE), strokes, on_step=stop)


def test_without_a_solver_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "maxflow", None)
    monkeypatch.setitem(sys.modules, "ortools.graph.python.max_flow", None)
    with pytest.raises(ImportError, match="graphcut"):
        edit(noise(3, *SIZE), [Stroke(DOT, (10, 12))])


# ------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Objects(whole=-1.0), "whole=-1.0"),
        (lambda: Objects(doubt=1.0), "doubt=1.0"),
        (lambda: Objects(level=0.0), "level=0.0"),
    ],
)
def test_bad_numbers_are_refused(call: Callable[[], Objects], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"strokes": []}, "strokes is empty"),
        ({"reference": noise(3, 30, 30)}, r"stroke 1: mask has shape \(56, 60\)"),
        ({"reference": noise(1, *SIZE)}, "reference has 1 channels and base 3"),
        ({"reference": noise(3, *SIZE).float()}, "reference is torch.float32"),
        ({"base": torch.full((3, *SIZE), torch.nan, dtype=torch.float64)}, "base holds NaN"),
        ({"reference_mask": DOT[:9]}, "reference_mask has shape"),
        ({"strokes": [Stroke(DOT, (99, 0))]}, r"stroke 1: offset=\(99, 0\) leaves nothing"),
        ({"strokes": [Stroke(DOT, (0, -999))]}, "leaves nothing of the mark inside"),
        ({"strokes": [Stroke(DOT, (0, 0)), Stroke(DOT, (-40, 0))]}, "stroke 2: offset"),
        ({"reference_mask": ~disk(20.0, 20.0, 9.0)}, "leaves nothing"),
        ({"data_cost": 0.0}, "data_cost=0.0"),
        ({"k1": -1.0}, "k1=-1.0"),
        ({"k1": 0.0, "k2": 0.0}, "without a cost"),
        ({"band": 0}, "band=0 must be at least 1"),
    ],
)
def test_bad_input_is_refused(change: dict[str, object], words: str) -> None:
    options: dict[str, object] = {"base": noise(3, *SIZE), "strokes": [Stroke(DOT, (10, 12))]}
    with pytest.raises(ValueError, match=words):
        edit(**(options | change))  # type: ignore[arg-type]
