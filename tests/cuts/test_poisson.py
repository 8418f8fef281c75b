"""Poisson: every solver equals a dense solve, gradients are those of the minimum, bad input."""

import doctest
from typing import Literal

import pytest
import torch
from conftest import noise
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from torchtex.cuts import laplace, poisson
from torchtex.cuts.poisson import Guidance, from_labels, gradients, mixed, solve
from torchtex.quadratic import threads

METHODS: tuple[Literal["direct", "iterative"], ...] = ("direct", "iterative")


def rectangle(h: int, w: int, rows: slice, cols: slice) -> Tensor:
    mask = torch.zeros(h, w, dtype=torch.bool)
    mask[rows, cols] = True
    return mask


def random_mask(h: int, w: int, seed: int = 0, share: float = 0.6) -> Tensor:
    mask = noise(h, w, seed=seed) < share
    mask[0], mask[-1], mask[:, 0], mask[:, -1] = False, False, False, False
    return mask


def random_guidance(c: int, h: int, w: int, *, periodic: bool = False, seed: int = 1) -> Guidance:
    cut = 0 if periodic else 1
    right = noise(c, h, w - cut, seed=seed) - 0.5
    return Guidance(right, noise(c, h - cut, w, seed=seed + 1) - 0.5, periodic)


def energy(f: Tensor, guidance: Guidance) -> Tensor:
    ours = gradients(f, periodic=guidance.periodic)
    right, down = ours.right - guidance.right, ours.down - guidance.down
    return right.square().sum() + down.square().sum()


def dense(guidance: Guidance, base: Tensor, mask: Tensor) -> Tensor:
    """The minimum by a dense least-norm solve: the change of base, zero outside the mask."""

    def slope(values: Tensor) -> Tensor:
        start = base.detach().clone().masked_scatter(mask, values).requires_grad_()
        (found,) = torch.autograd.grad(energy(start, guidance) / 2, start, create_graph=True)
        return found[:, mask].flatten()

    start = base[:, mask].flatten()
    hessian = torch.autograd.functional.jacobian(slope, start)
    change = torch.linalg.pinv(hessian, rtol=1e-12) @ slope(start)
    return base.masked_scatter(mask, start - change.detach())


SHAPES = {
    "inside": rectangle(9, 10, slice(2, 7), slice(1, 9)),
    "top": rectangle(9, 10, slice(0, 5), slice(3, 8)),
    "bottom right": rectangle(9, 10, slice(4, 9), slice(6, 10)),
    "across": rectangle(9, 10, slice(3, 6), slice(0, 10)),
    "left half": rectangle(9, 10, slice(0, 9), slice(0, 5)),
    "whole": rectangle(9, 10, slice(0, 9), slice(0, 10)),
    "pixel": rectangle(9, 10, slice(4, 5), slice(5, 6)),
    "corner": rectangle(9, 10, slice(0, 1), slice(9, 10)),
    "row of 1": rectangle(1, 10, slice(0, 1), slice(3, 10)),
    "whole row": rectangle(1, 10, slice(0, 1), slice(0, 10)),
    "whole column": rectangle(7, 1, slice(0, 7), slice(0, 1)),
    "one pixel": rectangle(1, 1, slice(0, 1), slice(0, 1)),
    "two pixels": rectangle(2, 1, slice(0, 1), slice(0, 1)),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("name", SHAPES)
def test_rectangles_equal_a_dense_solve(name: str, periodic: bool, method: str) -> None:
    mask = SHAPES[name]
    h, w = mask.shape
    base, guidance = noise(2, h, w), random_guidance(2, h, w, periodic=periodic)
    found = solve(guidance, base, mask, boundary="free", method=method, tolerance=1e-12)
    torch.testing.assert_close(found, dense(guidance, base, mask), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_any_mask_equals_a_dense_solve(seed: int, periodic: bool) -> None:
    mask = noise(9, 12, seed=seed) < (0.3, 0.6, 0.9, 0.97)[seed]
    base, guidance = noise(2, 9, 12), random_guidance(2, 9, 12, periodic=periodic)
    found = solve(guidance, base, mask, boundary="free", tolerance=1e-12)
    torch.testing.assert_close(found, dense(guidance, base, mask), rtol=1e-8, atol=1e-9)
    assert torch.equal(found[:, ~mask], base[:, ~mask])


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_gradients_of_an_image_give_it_back_with_its_mean_from_base(
    method: str, periodic: bool
) -> None:
    image, base = noise(3, 17, 13), noise(3, 17, 13, seed=1)
    guidance = gradients(image, periodic=periodic)
    found = solve(guidance, base, boundary="free", method=method, tolerance=1e-12)
    mean = image.mean((1, 2), keepdim=True) - base.mean((1, 2), keepdim=True)
    torch.testing.assert_close(found, image - mean, rtol=0, atol=1e-9)
    mask = random_mask(17, 13)
    held = torch.where(mask, base, image)
    found = solve(guidance, held, mask, tolerance=1e-12)
    torch.testing.assert_close(found, image, rtol=0, atol=1e-9)


def test_harmonic_functions_are_reproduced() -> None:
    y, x = torch.meshgrid(*2 * [torch.arange(20, dtype=torch.float64)], indexing="ij")
    harmonic = torch.stack([x * y, x**2 - y**2, 3 * x - y]) / 400
    mask = random_mask(20, 20)
    base = torch.where(mask, 0.0, harmonic)
    still = Guidance(torch.zeros(3, 20, 19).double(), torch.zeros(3, 19, 20).double())
    for where in (mask, rectangle(20, 20, slice(3, 15), slice(1, 18))):
        base = torch.where(where, 0.0, harmonic)
        found = solve(still, base, where, tolerance=1e-12)
        torch.testing.assert_close(found, harmonic, rtol=0, atol=1e-10)


def test_components_do_not_touch_each_other() -> None:
    base, guidance = noise(1, 20, 24), random_guidance(1, 20, 24)
    parts = [
        rectangle(20, 24, slice(1, 7), slice(2, 9)),
        rectangle(20, 24, slice(8, 15), slice(2, 9)),  # one row of given pixels lies between
        rectangle(20, 24, slice(3, 19), slice(12, 23)),
    ]
    together = solve(guidance, base, torch.stack(parts).any(0), tolerance=1e-12)
    for part in parts:
        alone = solve(guidance, base, part)
        torch.testing.assert_close(together[:, part], alone[:, part], rtol=0, atol=1e-9)


def test_no_small_change_lowers_the_energy() -> None:
    base, guidance, mask = noise(1, 12, 11), random_guidance(1, 12, 11), random_mask(12, 11)
    found = solve(guidance, base, mask, tolerance=1e-10)
    least = energy(found, guidance)
    for seed in range(8):
        other = found + 1e-3 * mask * (noise(1, 12, 11, seed=seed) - 0.5)
        assert energy(other, guidance) > least


@pytest.mark.parametrize(
    ("mask", "periodic"),
    [
        (random_mask(4, 5), False),
        (random_mask(4, 5), True),
        (rectangle(4, 5, slice(1, 3), slice(1, 4)), False),
        (rectangle(4, 5, slice(0, 3), slice(2, 5)), False),
        (rectangle(4, 5, slice(0, 4), slice(0, 5)), False),
        (rectangle(4, 5, slice(0, 4), slice(0, 5)), True),
    ],
    ids=["mask", "periodic mask", "inside", "corner", "whole", "torus"],
)
def test_gradcheck(mask: Tensor, periodic: bool) -> None:
    guidance = random_guidance(1, 4, 5, periodic=periodic)
    inputs = [x.requires_grad_() for x in (guidance.right, guidance.down, noise(1, 4, 5))]

    def found(right: Tensor, down: Tensor, base: Tensor) -> Tensor:
        field = Guidance(right, down, periodic)
        return solve(field, base, mask, boundary="free", tolerance=1e-12).square()

    assert gradcheck(found, inputs)
    assert gradgradcheck(found, inputs, fast_mode=True)


def test_gradcheck_of_the_guidance() -> None:
    inputs = [noise(2, 4, 5, seed=seed).requires_grad_() for seed in range(2)]
    labels = (noise(4, 5, seed=3) > 0.5).long()

    def fields(a: Tensor, b: Tensor) -> tuple[Tensor, ...]:
        montage, strong = from_labels([a, b], labels, periodic=True), mixed(a, b)
        return montage.right, montage.down, strong.right, strong.down

    assert gradcheck(fields, inputs)


@pytest.mark.parametrize("periodic", [False, True])
def test_montage_is_its_source_inside_a_region_and_the_mean_across_a_seam(periodic: bool) -> None:
    sources = [noise(2, 6, 7, seed=seed) for seed in range(3)]
    labels = torch.randint(3, (6, 7), generator=torch.Generator().manual_seed(0))
    found = from_labels(sources, labels, periodic=periodic)
    fields = [gradients(source, periodic=periodic) for source in sources]
    h, w = labels.shape
    for y in range(h):
        for x in range(w):
            for step, ours, theirs in (
                ((0, 1), found.right, [field.right for field in fields]),
                ((1, 0), found.down, [field.down for field in fields]),
            ):
                if not periodic and (y + step[0] == h or x + step[1] == w):
                    continue
                a, b = labels[y, x], labels[(y + step[0]) % h, (x + step[1]) % w]
                wanted = (theirs[a][:, y, x] + theirs[b][:, y, x]) / 2
                torch.testing.assert_close(ours[:, y, x], wanted)


def test_a_montage_of_one_image_with_other_brightness_has_no_seam() -> None:
    image = noise(1, 12, 14)
    labels = rectangle(12, 14, slice(0, 12), slice(0, 6)).long()
    found = solve(from_labels([image, image + 0.4], labels), image, boundary="free")
    torch.testing.assert_close(found, image, rtol=0, atol=1e-12)


def test_mixed_takes_the_stronger_edge_and_all_its_channels() -> None:
    base, source = noise(3, 8, 9), noise(3, 8, 9, seed=1)
    a, b, found = gradients(base).right, gradients(source).right, mixed(base, source).right
    theirs = b.norm(dim=0) > a.norm(dim=0)
    assert theirs.any()
    assert not theirs.all()
    assert torch.equal(found[:, theirs], b[:, theirs])
    assert torch.equal(found[:, ~theirs], a[:, ~theirs])


def test_an_empty_mask_gives_base_back() -> None:
    base = noise(2, 5, 6)
    found = solve(random_guidance(2, 5, 6), base, torch.zeros(5, 6, dtype=torch.bool))
    assert torch.equal(found, base)
    assert found is not base


def residual(found: Tensor, guidance: Guidance, base: Tensor, mask: Tensor) -> float:
    """Norm of the energy's slope inside the mask, relative to that at base, in float64."""
    norms = []
    for image in (found, base):
        start = image.double().requires_grad_()
        wide = Guidance(guidance.right.double(), guidance.down.double(), guidance.periodic)
        (slope,) = torch.autograd.grad(energy(start, wide), start)
        norms.append(float((slope * mask).norm()))
    return norms[0] / norms[1]


@pytest.mark.parametrize(
    ("kind", "method"),
    [(kind, "iterative") for kind in ("rectangle", "one hole", "comb", "long")]
    + [(kind, "direct") for kind in ("rectangle", "long")],
)
def test_float32_stays_float32_and_solves_well(kind: str, method: str) -> None:
    h, w = (3, 900) if kind == "long" else (120, 131)
    mask = rectangle(h, w, slice(1, h - 1), slice(1, w - 1))
    if kind == "one hole":
        mask = torch.ones(h, w, dtype=torch.bool)
        mask[40, 71] = False
    elif kind == "comb":
        mask[3:-3, ::4] = False
    image = noise(2, h, w, dtype=torch.float32)
    base = torch.where(mask, 0.0, image + 0.2)
    guidance = gradients(image)
    found = solve(guidance, base, mask, boundary="free", method=method)
    assert found.dtype == torch.float32
    assert residual(found, guidance, base, mask) < 3e-5
    assert (found - image - 0.2).abs().max() < 2e-3


def test_few_iterations_suffice() -> None:
    base, mask = noise(1, 150, 160), random_mask(150, 160)
    mask[20:100, 30:120] = True
    for periodic in (False, True):
        field = random_guidance(1, 150, 160, periodic=periodic)
        found = solve(field, base, mask, steps=12, tolerance=1e-9)
        assert residual(found, field, base, mask) < 1e-5
    thin = random_guidance(1, 1, 3000)
    row = rectangle(1, 3000, slice(0, 1), slice(1, 2999))
    found = solve(thin, noise(1, 1, 3000), row, boundary="free", method="iterative", steps=25)
    assert residual(found, thin, noise(1, 1, 3000), row) < 1e-4


def test_same_bits_for_any_number_of_threads() -> None:
    image, base = noise(3, 200, 220, dtype=torch.float32), torch.full((3, 200, 220), 0.5)
    guidance = gradients(image)
    masks = [random_mask(200, 220), rectangle(200, 220, slice(5, 190), slice(3, 200))]
    found = []
    for count in (1, 2):
        with threads(count):
            found.append([solve(guidance, base, mask) for mask in masks])
            found[-1].append(solve(guidance, base, boundary="free"))
    for one, two in zip(*found, strict=True):
        assert torch.equal(one, two)


def test_bad_input_gets_one_sentence(unchecked: None) -> None:
    base, guidance = noise(1, 6, 7), random_guidance(1, 6, 7)
    inside, whole = random_mask(6, 7), torch.ones(6, 7, dtype=torch.bool)
    for mask in (whole, None, rectangle(6, 7, slice(0, 2), slice(2, 3))):
        with pytest.raises(ValueError, match=r"mask touches the image border.*free"):
            solve(guidance, base, mask)
    with pytest.raises(ValueError, match="bring them to one size"):
        solve(guidance, noise(1, 6, 8), inside)
    with pytest.raises(ValueError, match="bring them to one size"):
        solve(guidance, base, inside[:-1])
    with pytest.raises(ValueError, match="convert both"):
        solve(guidance, base.float(), inside)
    half = Guidance(guidance.right.half(), guidance.down.half())
    with pytest.raises(ValueError, match="convert both"):
        solve(half, base.half(), inside)
    with pytest.raises(ValueError, match="base holds NaN"):
        solve(guidance, base / 0, inside)
    with pytest.raises(ValueError, match="guidance holds NaN"):
        solve(Guidance(guidance.right / 0, guidance.down), base, inside)
    with pytest.raises(ValueError, match="filled rectangle"):
        solve(guidance, base, inside, method="direct")
    with pytest.raises(ValueError, match="tolerance=0"):
        solve(guidance, base, inside, tolerance=0.0)
    with pytest.raises(ValueError, match="boundary='neumann' must be"):
        solve(guidance, base, inside, boundary="neumann")
    with pytest.raises(ValueError, match="method='fft' must be"):
        solve(guidance, base, inside, method="fft")
    with pytest.raises(ValueError, match="fit no image"):
        Guidance(guidance.right, guidance.down, periodic=True)
    with pytest.raises(ValueError, match="sources is empty"):
        from_labels([], torch.zeros(6, 7, dtype=torch.long))
    with pytest.raises(ValueError, match="one frame"):
        from_labels([base], torch.zeros(5, 7, dtype=torch.long))
    with pytest.raises(ValueError, match="labels run from 0 to 1"):
        from_labels([base], inside.long())
    with pytest.raises(ValueError, match="one size"):
        mixed(base, noise(1, 5, 7))


def test_the_examples_run() -> None:
    for module in (poisson, laplace):
        assert doctest.testmod(module, extraglobs={"torch": torch}).failed == 0
