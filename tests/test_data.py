"""The bundled exemplars."""

import doctest
import re
from pathlib import Path

import pytest
import torch

from torchtex import data


@pytest.mark.parametrize("name", data.names())
def test_exemplars_are_small_images_that_are_not_flat(name: str) -> None:
    image = data.load(name)
    assert image.dtype == torch.float32
    assert image.shape[0] in (1, 3)
    assert image.shape[1:] == (128, 128)
    assert image.min() >= 0
    assert image.max() <= 1
    assert image.std() > 0.02


def test_there_are_grey_and_colour_exemplars() -> None:
    channels = [data.load(name).shape[0] for name in data.names()]
    assert channels.count(1) >= 2
    assert channels.count(3) >= 2


def test_sources_state_the_licence_of_each_file() -> None:
    table = (Path(data.__file__).parent / "exemplars" / "SOURCES.md").read_text()
    rows = re.findall(
        r"^\| (\w+)\.png \| 128x128, (?:grey|RGB) \| (.+) \| (.+) \| .+ \|$", table, re.M
    )
    assert tuple(sorted(row[0] for row in rows)) == data.names()
    assert all(
        re.search("CC0|Creative Commons|public domain|No known copyright", row[2]) for row in rows
    )


def test_a_wrong_name_lists_the_right_ones() -> None:
    with pytest.raises(ValueError, match=r"name='brick' .* bricks, galaxies, grass"):
        data.path("brick")
    with pytest.raises(ValueError, match="wood"):
        data.load("../pyproject")


def test_the_examples_run() -> None:
    assert doctest.testmod(data).failed == 0
