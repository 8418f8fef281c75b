"""Blend: tone of base, detail of source; placing and clipping; one sentence for bad input."""

import doctest

import pytest
import torch
from conftest import noise, spots, stripes
from torch.autograd import gradcheck

from torchtex.cuts.poisson import gradients
from torchtex.recipes import blend as module
from torchtex.recipes.blend import blend, paste


def disk(side: int = 16) -> torch.Tensor:
    at = torch.arange(side) - side / 2 + 0.5
    return at[:, None] ** 2 + at**2 < (0.4 * side) ** 2


def test_a_brighter_copy_of_base_vanishes() -> None:
    base = stripes(32, 40)
    source, mask = base[:, 5:21, 7:23] + 0.3, disk()
    done = blend(base, source, mask, (5, 7), tolerance=1e-10)
    torch.testing.assert_close(done.image, base, rtol=0, atol=1e-8)
    assert (done.pasted - base).abs().max() > 0.29
    assert torch.equal(done.mask[5:21, 7:23], mask)
    assert done.lost == 0


def test_outside_the_mask_base_is_kept_to_the_bit() -> None:
    done = blend(stripes(), noise(3, 16, 16), disk(), (9, 3))
    assert torch.equal(done.image[:, ~done.mask], stripes()[:, ~done.mask])
    assert torch.equal(done.pasted, paste(stripes(), noise(3, 16, 16), disk(), (9, 3)))
    assert torch.equal(done.pasted[:, 9:25, 3:19][:, disk()], noise(3, 16, 16)[:, disk()])


def test_the_border_is_smoother_than_that_of_a_paste_and_the_detail_is_that_of_source() -> None:
    base, source, mask = 0.5 * stripes(48, 48, 1), 0.5 + 0.5 * spots(32), disk(32)
    done = blend(base, source, mask, (8, 8))
    border = done.mask[:, 1:] != done.mask[:, :-1]

    def jump(image: torch.Tensor) -> float:
        return float(gradients(image).right[:, border].abs().mean())

    assert jump(done.image) < 0.5 * jump(done.pasted)
    inside = (done.mask[:, 1:] & done.mask[:, :-1])[8:40, 8:39]
    ours = gradients(done.image).right[:, 8:40, 8:39][:, inside]
    theirs = gradients(source).right[:, inside]
    assert torch.corrcoef(torch.stack([ours.flatten(), theirs.flatten()]))[0, 1] > 0.9


@pytest.mark.parametrize("offset", [(-5, -6), (25, 30), (-3, 20), (0, 0), (31, 12)])
def test_what_lies_outside_is_cut_off(offset: tuple[int, int]) -> None:
    base, source = stripes(32, 36), noise(3, 16, 16)
    mask = torch.ones(16, 16, dtype=torch.bool)
    done = blend(base, source, mask, offset)
    row, col = offset
    rows = range(max(0, row), min(32, row + 16))
    cols = range(max(0, col), min(36, col + 16))
    assert int(done.mask.sum()) == len(rows) * len(cols)
    assert done.lost == 256 - len(rows) * len(cols)
    for y in rows:
        for x in cols:
            assert torch.equal(done.pasted[:, y, x], source[:, y - row, x - col])
    assert torch.equal(done.image[:, ~done.mask], base[:, ~done.mask])


def test_a_cut_piece_does_not_depend_on_where_it_was_cut() -> None:
    base, source, mask = stripes(24, 24), noise(3, 16, 16), disk()
    whole = blend(base, source, mask, (-4, 5), tolerance=1e-10)
    cut = blend(base, source[:, 4:], mask[4:], (0, 5), tolerance=1e-10)
    torch.testing.assert_close(whole.image, cut.image, rtol=0, atol=1e-9)


def test_source_may_be_larger_than_base_and_cover_it() -> None:
    base, source = stripes(12, 10), noise(3, 30, 40)
    mask = torch.ones(30, 40, dtype=torch.bool)
    done = blend(base, source, mask, (-7, -9))
    assert done.mask.all()
    torch.testing.assert_close(done.image.mean((1, 2)), base.mean((1, 2)))
    field = gradients(source[:, 7:19, 9:19]).right
    torch.testing.assert_close(gradients(done.image).right, field)


def test_mixed_keeps_lines_of_base_under_a_flat_source() -> None:
    base = stripes(32, 32)
    flat = torch.full((3, 16, 16), 0.7, dtype=torch.float64)
    plain = blend(base, flat, disk(), (8, 8), tolerance=1e-10)
    kept = blend(base, flat, disk(), (8, 8), mixed=True, tolerance=1e-10)
    torch.testing.assert_close(kept.image, base, rtol=0, atol=1e-8)
    assert (plain.image - base).abs().max() > 0.2


def test_gradcheck_in_both_images() -> None:
    mask = torch.tensor([[True, True, False], [True, False, True]])

    def image(base: torch.Tensor, source: torch.Tensor) -> torch.Tensor:
        return blend(base, source, mask, (1, 2), tolerance=1e-12).image

    inputs = (noise(1, 4, 5).requires_grad_(), noise(1, 2, 3, seed=1).requires_grad_())
    assert gradcheck(image, inputs)


def test_bad_input_gets_one_sentence(unchecked: None) -> None:
    base, source, mask = stripes(), noise(3, 16, 16), disk()
    with pytest.raises(ValueError, match="mask is empty"):
        blend(base, source, torch.zeros_like(mask))
    with pytest.raises(ValueError, match="source has 1 channels and base 3"):
        blend(base, source[:1], mask)
    with pytest.raises(ValueError, match="mask has shape"):
        blend(base, source, mask[1:])
    for offset in ((32, 0), (0, -16), (100, 100), (-15, 0)):
        with pytest.raises(ValueError, match="outside base of 32 x 32"):
            blend(base, source, mask, offset)
    with pytest.raises(ValueError, match="source holds NaN"):
        blend(base, source / 0, mask)
    with pytest.raises(ValueError, match="base holds NaN"):
        blend(base / 0, source, mask)
    with pytest.raises(ValueError, match="convert one of them"):
        blend(base, source.float(), mask)
    with pytest.raises(ValueError, match="mask touches the image border"):
        blend(base, source, mask, (-5, 0), boundary="dirichlet")
    with pytest.raises(ValueError, match="no pixels"):
        blend(base, source[:, :0], mask[:0])


def test_the_examples_run() -> None:
    assert doctest.testmod(module).failed == 0
