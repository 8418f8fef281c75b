"""What recipes are given: sentences for what makes no sense, and the layout of blocks."""

import math
import re
from collections.abc import Callable

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex import inputs
from torchtex.inputs import check_seed, check_size, memory_of, usable_exemplars
from torchtex.layouts import Layout, layout_of, places_of

Z = noise(3, 10, 12)
FULL = torch.ones(10, 12, dtype=torch.bool)


def test_what_a_mask_leaves_out_may_be_anything() -> None:
    mask = FULL.clone()
    mask[2, 3] = False
    z = Z.clone()
    z[:, 2, 3] = math.nan
    zs, keep = usable_exemplars([z, Z.requires_grad_()], [mask, None])
    assert torch.equal(zs[0], torch.where(mask, Z, 0))
    assert keep[0] is mask
    assert keep[1] is None
    assert not zs[1].requires_grad


@pytest.mark.parametrize(
    ("exemplars", "masks", "words"),
    [
        ([], None, "exemplar: none given"),
        ([Z, Z[:1]], None, "one has 3 channels and another 1"),
        (Z / 0, None, "exemplar holds NaN or infinity"),
        (Z, [FULL, FULL], "mask: 2 given for 1"),
        (Z, FULL[1:], "mask is 9x12 and its exemplar 10x12"),
        (Z, ~FULL, "mask is empty"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_exemplars_and_masks(
    exemplars: list[Tensor] | Tensor, masks: list[Tensor] | Tensor | None, words: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        usable_exemplars(exemplars, masks)


def test_exemplars_are_of_one_kind_of_number() -> None:
    with pytest.raises(TypeError, match=r"float64 beside torch\.float32"):
        usable_exemplars([Z.float(), Z])
    with pytest.raises(TypeError, match="float16"):
        usable_exemplars(Z.half())


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: check_size((0, 5)), "size=0x5 must be at least 1x1"),
        (lambda: check_size((5, 5), 2**60), "size=5x5 would need about 1073741824.0 GiB"),
        (lambda: check_seed(2**63), "seed=9223372036854775808 must lie in"),
        (lambda: inputs.check_not_negative("k", math.nan), "k=nan must be at least 0"),
        (
            lambda: layout_of([Z], (30, 30), 11, None, share=0.3, name="patch"),
            "patch=11 must lie in 3..10",
        ),
        (
            lambda: layout_of([Z], (3, 30), 8, 2, share=0.3, name="patch"),
            "at most half of size=3x30",
        ),
        (
            lambda: places_of([Z], [torch.eye(10, 12, dtype=torch.bool)], 3, "patch"),
            "patch=3 fits nowhere in the masks; choose a smaller patch",
        ),
    ],
)
def test_other_bad_input(call: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        call()


def test_any_size_is_tried_where_the_system_does_not_tell_its_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(inputs.os, "sysconf")
    check_size((5, 5), 2**60)


def test_memory_grows_with_pixels_channels_and_precision() -> None:
    assert memory_of(Z, (4, 5), images=2, numbers=3) == 20 * (2 * 3 * 8 + 24)
    assert memory_of(Z[:1].float(), (4, 5), images=2, numbers=0) == 20 * 8


@pytest.mark.parametrize("size", [(5, 8), (20, 30), (21, 33)])
def test_blocks_cover_the_size_and_no_more_than_needed(size: tuple[int, int]) -> None:
    layout = Layout(size, 8, 2)
    rows, cols = layout.count
    covered = torch.zeros(layout.extent, dtype=torch.long)
    for i in range(rows):
        for j in range(cols):
            known = covered[layout.window(i, j)] > 0
            assert torch.equal(known, layout.known(i, j, known.device))
            covered[layout.window(i, j)] += 1
    assert bool((covered > 0).all())
    for extent, wanted in zip(layout.extent, size, strict=True):
        assert wanted <= extent < max(wanted, 9) + layout.step
    assert layout.padded(noise(1, *size)).shape[1:] == layout.extent


def test_shrunk_blocks_still_overlap_by_less_than_half() -> None:
    for ratio in (1.0, 0.5, 0.1):
        small = Layout((30, 30), 12, 5).shrunk(ratio)
        assert 3 <= small.side <= 12
        assert 1 <= small.overlap <= (small.side - 1) // 2
