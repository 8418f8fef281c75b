"""Flows that follow drawn lines."""

import doctest
import math

import pytest
import torch

from torchtex.flow import strokes
from torchtex.flow.strokes import Strokes

ARROW = ((0.5, 0.2), (0.5, 0.8))


@pytest.mark.parametrize("width", [None, 0.15])
@pytest.mark.parametrize("periodic", [False, True])
def test_pixels_on_a_line_follow_it(width: float | None, periodic: bool) -> None:
    arc = [(0.5 - 0.3 * math.sin(t), 0.5 - 0.3 * math.cos(t)) for t in torch.linspace(0, 3, 12)]
    flow = Strokes([[(float(r), float(c)) for r, c in arc]], 2.0, width, periodic=periodic)
    field = flow(0, 64, 64)
    for t in (0.6, 1.5, 2.4):
        row, column = 0.5 - 0.3 * math.sin(t), 0.5 - 0.3 * math.cos(t)
        found = field[:, round(row * 64 - 0.5), round(column * 64 - 0.5)]
        tangent = torch.tensor([-math.cos(t), math.sin(t)], dtype=torch.float64)
        assert float(found @ tangent) / 2.0 > 0.8
        assert float(found @ tangent / found.norm()) > 0.97
    assert field.square().sum(0).sqrt().max() <= 2.0 + 1e-9


def test_one_arrow_moves_everything_alike_or_only_what_is_near() -> None:
    everywhere = Strokes((ARROW,), 2.0)(0, 32, 48)
    torch.testing.assert_close(everywhere[1], torch.full((32, 48), 2.0).double())
    near = Strokes((ARROW,), 2.0, width=0.1)(0, 32, 48)
    assert near[1, 16, 24] > 1.6
    assert near[:, 0].abs().max() < 0.05


def test_lines_that_contradict_each_other_cancel() -> None:
    field = Strokes((ARROW, ARROW[::-1]), 2.0)(0, 32, 32)
    assert field.abs().max() < 1e-6


def test_a_line_over_the_edge_of_a_tile_comes_in_at_the_other_side() -> None:
    flow = Strokes((((0.5, 0.8), (0.5, 1.2)),), 2.0, width=0.1, periodic=True)
    field = flow(0, 40, 40)
    assert field[1, 20, 0] > 1.5
    assert field[1, 20, -1] > 1.5
    assert field[1, 20, 20] < 0.2


def test_wrong_strokes_are_refused_in_a_sentence() -> None:
    with pytest.raises(ValueError, match="strokes are empty"):
        Strokes(())
    with pytest.raises(ValueError, match=r"strokes\[1\] has no length"):
        Strokes((ARROW, ((0.1, 0.1), (0.1, 0.1))))
    with pytest.raises(ValueError, match=r"strokes\[0\]=.* must be finite"):
        Strokes((((0.1, math.nan), (0.1, 0.1)),))
    with pytest.raises(ValueError, match=r"width=0\.0 must be above 0"):
        Strokes((ARROW,), width=0.0)
    with pytest.raises(ValueError, match=r"smoothing=-1\.0 must be at least 0"):
        Strokes((ARROW,), smoothing=-1.0)


def test_examples() -> None:
    assert doctest.testmod(strokes, extraglobs={"torch": torch}).failed == 0
