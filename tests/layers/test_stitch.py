"""Stitched layers: copies of their sources, the best seam, holes where none is."""

from dataclasses import replace
from itertools import product

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex.cuts.mincut import MinCut
from torchtex.layers.deform import Deformation, Deformed, deform
from torchtex.layers.stitch import Part, stitch
from torchtex.sources import copied, pixel_places


def part(image: Tensor, mask: Tensor, at: tuple[int, int] = (0, 0), exemplar: int = 0) -> Part:
    places = torch.nn.functional.pad(pixel_places(mask.shape), (1, 0))
    field = copied(places, ((mask.shape[0], mask.shape[1]),))
    return Part(Deformed(image, mask, field), at, exemplar)


def boxed(size: tuple[int, int], rows: slice, cols: slice) -> Tensor:
    mask = torch.zeros(size, dtype=torch.bool)
    mask[rows, cols] = True
    return mask


def test_every_pixel_is_of_a_part_that_has_it_and_others_are_holes(solver: MinCut) -> None:
    images = [noise(3, 20, 24, seed=n) for n in range(3)]
    masks = [
        boxed((20, 24), slice(0, 12), slice(0, 24)),
        boxed((20, 24), slice(8, 18), slice(2, 14)),
        boxed((20, 24), slice(4, 14), slice(10, 20)),
    ]
    made = stitch(
        [part(i, m) for i, m in zip(images, masks, strict=True)],
        (20, 24),
        narrowest=1,
        solver=solver,
    )
    assert torch.equal(made.holes, ~torch.stack(masks).any(0))
    assert not bool(made.texture[:, made.holes].any())
    for number, (image, mask) in enumerate(zip(images, masks, strict=True)):
        own = made.owner == number
        assert bool(own.any())
        assert not bool((own & ~mask).any())
        assert torch.equal(made.texture[:, own], image[:, own])
        assert torch.equal(made.positions[own][:, 1:].long(), own.nonzero())


def test_the_seam_is_the_cheapest_one(solver: MinCut) -> None:
    old, new = noise(1, 3, 5, seed=4), noise(1, 3, 5, seed=5)
    masks = boxed((3, 5), slice(0, 3), slice(0, 4)), boxed((3, 5), slice(0, 3), slice(1, 5))
    made = stitch(
        [part(old, masks[0]), part(new, masks[1])], (3, 5), band=2, narrowest=1, solver=solver
    )
    core = torch.zeros(3, 5, dtype=torch.bool)
    core[1, 2:4] = True  # what half the band leaves
    apart = (old - new).abs()[0]
    apart[:, [0, 4]] = 0

    def cost(labels: Tensor) -> float:
        total = 0.0
        for axis in (0, 1):
            n = labels.shape[axis] - 1
            unlike = labels.narrow(axis, 0, n) != labels.narrow(axis, 1, n)
            both = masks[0] & masks[1]
            share = 2 / (both.narrow(axis, 0, n).int() + both.narrow(axis, 1, n).int())
            step = (apart.narrow(axis, 0, n) + apart.narrow(axis, 1, n)) * share
            total += float(step[unlike].sum())
        return total

    labels = made.owner == 1
    assert not bool(labels[:, 0].any())
    assert bool(labels[:, 4].all())
    least = float("inf")
    for bits in product((False, True), repeat=7):
        other = torch.zeros(3, 5, dtype=torch.bool)
        other[:, 4] = True
        free = [(r, c) for r in range(3) for c in (1, 2, 3) if not core[r, c]]
        for (r, c), bit in zip(free, bits, strict=True):
            other[r, c] = bit
        other |= core
        least = min(least, cost(other))
    assert cost(labels) == pytest.approx(least)


def test_a_part_on_another_stays_unless_it_is_too_thin() -> None:
    ground, thing = torch.zeros(1, 24, 24).double(), torch.ones(1, 24, 24).double()
    everywhere = torch.ones(24, 24, dtype=torch.bool)
    for mask, stays in (
        (boxed((24, 24), slice(6, 18), slice(6, 18)), True),
        (boxed((24, 24), slice(3, 20), slice(10, 15)), True),
        (boxed((24, 24), slice(3, 20), slice(10, 12)), False),
        (boxed((24, 24), slice(5, 7), slice(5, 7)), False),
    ):
        made = stitch([part(ground, everywhere), part(thing, mask)], (24, 24), narrowest=1)
        assert bool((made.owner == 1).any()) == stays
        assert not bool(((made.owner == 1) & ~mask).any())
        assert not bool(made.holes.any())


def test_slivers_become_holes_and_wide_parts_stay() -> None:
    image = noise(3, 20, 20)
    for mask, holes in (
        (boxed((20, 20), slice(0, 20), slice(8, 12)), True),
        (boxed((20, 20), slice(5, 10), slice(8, 13)), True),  # one square alone
        (boxed((20, 20), slice(4, 13), slice(5, 14)), False),
        (boxed((20, 20), slice(0, 3), slice(2, 20)), False),  # as if it went on outside
    ):
        made = stitch([part(image, mask)], (20, 20), narrowest=5)
        assert torch.equal(made.holes, torch.ones_like(mask) if holes else ~mask)
        assert not bool(made.texture[:, made.holes].any())


def test_a_whole_part_is_shown_however_small() -> None:
    ground, thing = noise(1, 24, 24), noise(1, 24, 24, seed=1)
    mask = boxed((24, 24), slice(5, 7), slice(5, 8))
    small = replace(part(thing, mask), whole=True)
    made = stitch([part(ground, torch.ones_like(mask)), small], (24, 24))
    assert torch.equal(made.owner == 1, mask)


def test_parts_may_hang_out_and_come_from_several_exemplars() -> None:
    image = noise(3, 10, 10)
    whole = torch.ones(10, 10, dtype=torch.bool)
    parts = [
        part(image, whole, (-4, -3)),
        part(image, whole, (20, 0)),
        part(image, whole, (2, 9), 1),
    ]
    made = stitch(parts, (12, 16), narrowest=1)
    assert torch.equal(made.texture[:, :6, :7], image[:, 4:, 3:])
    assert not bool((made.owner == 1).any())
    assert bool((made.positions[made.owner == 2][:, 0] == 1).all())


def test_positions_of_turned_parts_render_them() -> None:
    z = noise(3, 16, 16)
    made = stitch([Part(deform(z, Deformation(rotate=25.0)))], (16, 16))
    shown = copied(made.positions, ((16, 16),)).apply(z)
    assert torch.equal(shown[:, ~made.holes], made.texture[:, ~made.holes])


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="parts is empty"):
        stitch([], (4, 4))
    with pytest.raises(ValueError, match="narrowest=0"):
        stitch([part(noise(1, 4, 4), torch.ones(4, 4, dtype=torch.bool))], (4, 4), narrowest=0)
    with pytest.raises(ValueError, match="band=-1"):
        stitch([part(noise(1, 4, 4), torch.ones(4, 4, dtype=torch.bool))], (4, 4), band=-1)
