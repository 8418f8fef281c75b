"""Strokes: what is painted, distances, and marks that make no sense."""

import pytest
import torch

from torchtex.recipes.strokes import Stroke, brush, distance, polygon

SIZE = (56, 60)
DOT = brush(SIZE, [(20.0, 20.0)], 4.0)


def test_brushes_paint() -> None:
    assert brush((5, 7), [(2.0, 3.0)], 1.0).sum() == 5
    assert torch.equal(
        brush((5, 7), [(2.0, 1.0), (2.0, 5.0)], 0.5), polygon((5, 7), [
            (1.5, 0.5), (1.5, 5.5), (2.5, 5.5), (2.5, 0.5)
        ])
    )  # fmt: skip
    assert brush((5, 7), [(2.0, -3.0), (2.0, 0.0)], 1.0).sum() == 4  # partly outside


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: brush(SIZE, [(-20.0, 5.0)], 4.0), "path paints no pixel of the 56 x 60"),
        (lambda: brush(SIZE, [(2.0, 5.0)], 0.0), "radius=0.0 must be above 0"),
        (lambda: brush(SIZE, [], 1.0), "path is empty"),
        (lambda: polygon(SIZE, [(1.0, 1.0), (2.0, 2.0)]), "polygon has 2 points"),
        (lambda: polygon(SIZE, [(-9.0, 1.0), (-8.0, 2.0), (-9.0, 3.0)]), "polygon paints no"),
        (lambda: Stroke(torch.zeros(SIZE), (0, 0)), "mask is empty"),
        (lambda: Stroke(torch.full(SIZE, 0.3), (0, 0)), "mask is empty"),
        (lambda: Stroke(torch.full(SIZE, 1.3), (0, 0)), "outside 0..1"),
        (lambda: Stroke(torch.full(SIZE, torch.nan), (0, 0)), "outside 0..1"),
        (lambda: Stroke(DOT, (0, 0), scale=0.0), "scale=0.0 must be above 0"),
        (lambda: Stroke(DOT, (0, 0), scale=-1.0), "scale=-1.0 must be above 0"),
        (lambda: Stroke(DOT, (0, 0), rotation=float("inf")), "rotation=inf"),
    ],
)
def test_bad_strokes_are_refused(call: object, words: str) -> None:
    assert callable(call)
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize("limit", [1, 3, 40])
def test_distances_are_those_to_the_nearest_marked_pixel(limit: int) -> None:
    mask = torch.zeros(20, 23, dtype=torch.bool)
    mask[[3, 15, 16], [4, 20, 2]] = True
    place = torch.stack(torch.meshgrid(torch.arange(20), torch.arange(23), indexing="ij"), -1)
    apart = (place.flatten(0, 1)[:, None] - mask.nonzero()).double().norm(dim=2).amin(1)
    apart = apart.view(20, 23)
    near = apart <= limit
    assert torch.allclose(distance(mask, limit)[near], apart[near])
    assert bool((distance(mask, limit)[~near] > limit).all())
