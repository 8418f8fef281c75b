"""Filled holes: what is known stays, what is new is copied, coherent at the border."""

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex.recipes.fill import fill
from torchtex.recipes.montage import Stage
from torchtex.schedule import Level

SCHEDULE = (Level(0.5, 8, 2), Level(1.0, 8, 2))


def holes(kind: str, size: tuple[int, int] = (40, 44)) -> Tensor:
    mask = torch.zeros(size, dtype=torch.bool)
    if kind == "square":
        mask[14:26, 16:30] = True
    elif kind == "corner":
        mask[:12, :10] = True
    elif kind == "speckled":
        mask[10:22, 12:26] = noise(12, 14, seed=3) > 0.5
    else:
        mask[5:9, 30:40] = True
        mask[-6:, 2:12] = True
    return mask


def test_less_of_a_hole_is_filled_from_what_is_flatter_than_its_surroundings() -> None:
    image = noise(1, 48, 64)
    image[:, :, 44:] = 0.5  # seams cost nothing here
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[14:34, 12:32] = True
    shares = [
        float((fill(image, mask, detail=detail, schedule=SCHEDULE).source_map[mask][:, 2] >= 44)
              .double().mean())
        for detail in (0.0, 1.0)
    ]  # fmt: skip
    assert shares[1] < 0.6 * shares[0]


@pytest.mark.parametrize("kind", ["square", "corner", "speckled", "two"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_known_pixels_stay_and_new_ones_are_copies_of_known_ones(kind: str, channels: int) -> None:
    image, mask = stripes(40, 44, channels), holes(kind)
    result = fill(image, mask, poisson=False, schedule=SCHEDULE, seed=1)
    assert torch.equal(result.texture[:, ~mask], image[:, ~mask])
    assert torch.equal(result.apply(image), result.texture)
    which, row, col = result.source_map.unbind(-1)
    assert not which.any()
    assert not mask[row, col].any()
    assert bool((result.patches[mask] > 0).all())
    assert not result.patches[~mask].any()


def test_what_the_hole_holds_changes_nothing() -> None:
    image, mask = stripes(40, 44), holes("square")
    first = fill(image, mask, schedule=SCHEDULE)
    image[:, mask] = torch.nan
    assert torch.equal(fill(image, mask, schedule=SCHEDULE).texture, first.texture)


def test_threads_change_no_bit_and_poisson_keeps_the_rest() -> None:
    image, mask = stripes(40, 44), holes("two")
    first = fill(image, mask, schedule=SCHEDULE, seed=5)
    torch.set_num_threads(2)
    assert torch.equal(fill(image, mask, schedule=SCHEDULE, seed=5).texture, first.texture)
    assert torch.equal(first.texture[:, ~mask], image[:, ~mask])
    assert float(first.texture.min()) >= 0
    assert float(first.texture.max()) <= 1


def test_a_pattern_is_continued() -> None:
    row, col = torch.meshgrid(torch.arange(48), torch.arange(48), indexing="ij")
    image = (0.5 + 0.4 * torch.sin(2 * torch.pi * (row + 2 * col) / 8))[None].double()
    mask = holes("square", (48, 48))
    gap = fill(image, mask, schedule=SCHEDULE).texture - image
    assert float(gap.abs().max()) < 1e-6


def test_far_holes_are_solved_apart() -> None:
    image, mask = stripes(40, 120), torch.zeros(40, 120, dtype=torch.bool)
    mask[10:16, 5:12] = mask[20:25, 100:110] = True
    result = fill(image, mask, schedule=SCHEDULE)
    assert result.settings["holes"] == 2
    assert torch.equal(result.texture[:, ~mask], image[:, ~mask])


def test_progress_rises_and_can_cancel() -> None:
    stages: list[Stage] = []
    fill(stripes(40, 44), holes("corner"), schedule=SCHEDULE, on_step=stages.append)
    done = [stage.done for stage in stages]
    assert done == sorted(done)
    assert done[0] > 0
    assert done[-1] <= 1

    def stop(stage: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fill(stripes(40, 44), holes("corner"), schedule=SCHEDULE, on_step=stop)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mask": torch.zeros(40, 44, dtype=torch.bool)}, "mask is True nowhere"),
        ({"mask": torch.ones(40, 44, dtype=torch.bool)}, "mask is True everywhere"),
        ({"mask": torch.ones(9, 44, dtype=torch.bool)}, "mask is 9x44 and image 40x44"),
        ({"mask": torch.arange(44).expand(40, 44) % 7 == 0}, "no whole window of 8x8"),
        ({"confidence": -1.0}, "confidence=-1.0"),
        ({"border": float("nan")}, "border=nan"),
        ({"detail": -0.5}, "detail=-0.5"),
        ({"offsets": 0}, "offsets=0"),
        ({"reach": 0}, "reach=0"),
        ({"seed": -1}, "seed=-1"),
    ],
)
def test_bad_input(change: dict[str, object], words: str) -> None:
    given: dict[str, object] = {"mask": holes("square"), "schedule": SCHEDULE} | change
    with pytest.raises(ValueError, match=words):
        fill(stripes(40, 44), **given)  # type: ignore[arg-type]
