"""Patch-based sampling: blended copies, searches that agree, options that make no sense."""

from typing import Any

import pytest
import torch
from conftest import noise, stripes

from torchtex.qtp import Qtp
from torchtex.recipes.montage import Stage
from torchtex.recipes.patchwise import patchwise


@pytest.mark.parametrize("search", ["fft", "qtp", "exhaustive", Qtp(keep=(20, 5), axes=None)])
@pytest.mark.parametrize("size", [(50, 41), (1, 1), (12, 30)])
def test_the_texture_is_rendered_from_its_field(search: Any, size: tuple[int, int]) -> None:
    z = stripes(32, 36)
    result = patchwise(z, size, patch=12, search=search, seed=1)
    assert result.texture.shape == (3, *size)
    assert torch.equal(result.apply(z), result.texture)
    total = result.field.weights.sum(0)
    assert torch.allclose(total, torch.ones_like(total))
    assert -1e-9 <= result.texture.min() <= result.texture.max() <= 1 + 1e-9


def test_one_layer_copies_where_patches_do_not_overlap() -> None:
    z = noise(1, 24, 24)
    result = patchwise(z, (40, 40), patch=12, overlap=3, seed=2)
    alone = (result.field.weights > 0).sum(0) == 1
    assert alone.float().mean() > 0.3
    number, row, col = result.source_map[alone].T
    assert torch.allclose(z[0, row, col], result.texture[0, alone])
    assert (number == 0).all()


def test_a_patch_is_where_it_weighs_most() -> None:
    result = patchwise(noise(1, 24, 24), (12, 21), patch=12, overlap=3, seed=2)
    assert result.patches[0].tolist() == [0] * 11 + [1] * 10 or result.patches[0].tolist() == (
        [0] * 10 + [1] * 11
    )
    weights = result.field.weights
    assert torch.allclose(weights[0, 0, 8:13], torch.tensor([1, 0.75, 0.5, 0.25, 0]).double())


def test_exhaustive_and_fft_search_agree() -> None:
    z = noise(2, 24, 20, seed=3)
    made = [patchwise(z, (40, 36), search=search, seed=4) for search in ("fft", "exhaustive")]
    assert torch.equal(made[0].source_map, made[1].source_map)


def test_the_nearest_is_taken_where_none_is_near_enough() -> None:
    z = noise(1, 40, 40, seed=5)
    result = patchwise(z, (10, 28), patch=10, overlap=2, tolerance=0.0, seed=10)
    row, col = result.source_map[0, 0, 1:].tolist()
    cols = min(28, 32 - col)
    assert torch.allclose(result.texture[..., :cols], z[:, row : row + 10, col : col + cols])


def test_a_wide_tolerance_lets_patches_differ() -> None:
    z = noise(1, 40, 40, seed=5)
    strict = patchwise(z, (40, 40), patch=10, tolerance=0.0, seed=1)
    free = patchwise(z, (40, 40), patch=10, tolerance=5.0, seed=1)
    assert not torch.equal(strict.texture, free.texture)


@pytest.mark.parametrize("search", ["fft", "qtp", "exhaustive"])
def test_several_exemplars_and_masks(search: Any) -> None:
    zs = [stripes(24, 24), noise(3, 20, 30, seed=7)]
    masks = [torch.ones(24, 24, dtype=torch.bool), torch.zeros(20, 30, dtype=torch.bool)]
    masks[0][:, :6] = False
    masks[1][:11, 19:] = True
    zs[0][0, 0, 0] = torch.nan
    result = patchwise(
        zs, (40, 40), patch=10, tolerance=5.0, masks=masks, search=search, seed=8
    )  # fmt: skip
    number, row, col = result.field.positions.flatten(0, 2).T
    for n in number.unique().tolist():
        assert masks[n][row[number == n], col[number == n]].all()
    assert result.texture.isfinite().all()
    assert torch.equal(result.apply([z.nan_to_num() for z in zs]), result.texture)


@pytest.mark.parametrize("channels", [1, 4, 7])
def test_any_channels_and_dtype(channels: int) -> None:
    z = noise(channels, 20, 24, seed=2, dtype=torch.float32)
    result = patchwise(z, (30, 33), seed=3)
    assert result.texture.dtype == torch.float32
    assert len(result.texture) == channels


@pytest.mark.parametrize("search", ["fft", "qtp"])
def test_same_seed_same_bits_for_any_number_of_threads(search: Any) -> None:
    z = noise(3, 24, 24, dtype=torch.float32)
    made = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        made.append(patchwise(z, (40, 40), search=search, tolerance=0.5, seed=5).texture)
    assert torch.equal(*made)
    other = patchwise(z, (40, 40), search=search, tolerance=0.5, seed=6).texture
    assert not torch.equal(other, made[0])


def test_steps_are_told_and_may_cancel() -> None:
    stages: list[Stage] = []
    patchwise(noise(1, 20, 20), (40, 20), patch=12, overlap=2, on_step=stages.append)
    assert [round(stage.done, 3) for stage in stages] == [0.25, 0.5, 0.75, 1.0]
    assert stages[0].texture.shape == (1, 40, 20)
    assert (stages[0].texture[:, 12:] == 0).all()

    def cancel(stage: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        patchwise(noise(1, 20, 20), (40, 20), on_step=cancel)


def test_report_holds_the_settings() -> None:
    report = patchwise(noise(1, 25, 50), (30, 30), seed=4).report()
    assert report["settings"] == {
        "recipe": "patchwise", "size": [30, 30], "patch": 7, "overlap": 1, "tolerance": 0.1,
        "search": "fft",
    }  # fmt: skip


Z = noise(3, 20, 24)
NONE = torch.zeros(20, 24, dtype=torch.bool)
SMALL = NONE.clone()
SMALL[3:5] = True


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("patch=21 must lie in 3..20", {"patch": 21}),
        ("overlap=6 must be at least 1, less than half of patch=12", {"patch": 12, "overlap": 6}),
        ("overlap=0", {"overlap": 0}),
        ("overlap=4 .* half of size=7x30", {"patch": 12, "overlap": 4, "size": (7, 30)}),
        ("size=0x5", {"size": (0, 5)}),
        ("tolerance=-0.1", {"tolerance": -0.1}),
        ("tolerance=inf", {"tolerance": float("inf")}),
        ("seed=-1", {"seed": -1}),
        ("search='best' is unknown", {"search": "best"}),
        ("exemplar: none", {"exemplars": []}),
        ("one has 3 channels and another 1", {"exemplars": [Z, Z[:1]]}),
        ("exemplar holds NaN", {"exemplars": Z / 0}),
        ("mask: 1 given for 2", {"exemplars": [Z, Z], "masks": NONE}),
        ("mask is 20x23", {"masks": NONE[:, 1:]}),
        ("patch=6 fits nowhere in the masks", {"masks": SMALL}),
    ],
)
def test_what_makes_no_sense_is_refused(words: str, options: dict[str, Any]) -> None:
    given = {"exemplars": Z, "size": (30, 30)} | options
    with pytest.raises(ValueError, match=words):
        patchwise(given.pop("exemplars"), given.pop("size"), **given)
