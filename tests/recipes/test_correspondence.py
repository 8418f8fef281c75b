"""Maps for a transfer: lightness that fits that of the exemplars, sentences for bad maps."""

import pytest
import torch
from conftest import noise

from torchtex.recipes.correspondence import Correspondence, blurred_luminance

Z = noise(3, 20, 24)


def test_equal_pixels_of_a_target_get_equal_lightness() -> None:
    target = torch.full((1, 12, 12), 0.25)
    found = blurred_luminance([noise(3, 16, 16, dtype=torch.float32)], target)
    assert found.target.unique().numel() == 1
    raw = blurred_luminance([noise(3, 16, 16, dtype=torch.float32)], target, match=False)
    assert torch.allclose(raw.target, target)


@pytest.mark.usefixtures("unchecked")
def test_what_makes_no_sense_is_refused() -> None:
    with pytest.raises(ValueError, match="correspondence: 1 channels"):
        Correspondence((Z[:1],), Z)
    with pytest.raises(ValueError, match=r"sigma=0"):
        blurred_luminance([Z], Z, sigma=0)
