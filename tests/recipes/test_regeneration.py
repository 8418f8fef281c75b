"""Warps that moved textures are compared with."""

import pytest
import torch
from conftest import noise

from torchtex.flow.fields import Uniform
from torchtex.recipes.regeneration import regenerated_frames, warped_frames

STILL = Uniform((0.0, 0.0))


def test_rivals() -> None:
    image = noise(1, 24, 24)
    frames = list(warped_frames(image, Uniform((0.0, 2.0)), 4))
    assert torch.allclose(frames[3][:, :, 6:], image[:, :, :-6])
    anew = list(regenerated_frames(image, Uniform((0.0, 1.0)), 20))
    assert len(anew) == 20
    assert all(frame.min() >= 0 and frame.max() <= 1 for frame in anew)
    with pytest.raises(ValueError, match="life=2"):
        next(regenerated_frames(image, STILL, 2, life=2))
