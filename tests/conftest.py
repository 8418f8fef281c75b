"""Shared by all tests: one thread, small made-up images, the command line, the min-cuts.

torchtex is imported inside functions: shape checks begin after this file is read.
"""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

# read when torch is loaded: idle threads sleep, so two threads are quick even on busy cores
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import jaxtyping
import pytest
import torch
from torch import Tensor

if TYPE_CHECKING:
    from torchtex.cuts.mincut import MinCut
    from torchtex.meshes.mesh import Mesh


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def noise(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Independent uniform numbers in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, generator=generator, dtype=torch.float64).to(dtype)


def stripes(height: int = 32, width: int = 32, channels: int = 3, seed: int = 0) -> Tensor:
    """Slanted stripes with a little noise, another phase in each channel."""
    row = torch.arange(height, dtype=torch.float64)[:, None]
    col = torch.arange(width, dtype=torch.float64)[None]
    waves = [torch.sin(0.9 * row + 0.35 * col + k) for k in range(channels)]
    image = 0.5 + 0.35 * torch.stack(waves)
    return (image + 0.1 * (noise(channels, height, width, seed=seed) - 0.5)).clamp(0, 1)


def spots(side: int = 48, seed: int = 0) -> Tensor:
    """A flat ground with fine grain and one rare motif: a bright ring with a dark heart."""
    row = torch.arange(side, dtype=torch.float64)[:, None] - side * 0.4
    col = torch.arange(side, dtype=torch.float64)[None] - side * 0.6
    radius = (row**2 + col**2).sqrt()
    ring = torch.exp(-((radius - 5) ** 2) / 3) - 0.7 * torch.exp(-(radius**2) / 4)
    grain = 0.06 * (noise(1, side, side, seed=seed) - 0.5)
    return (0.4 + 0.55 * ring[None] + grain).clamp(0, 1)


def tetrahedron() -> "Mesh":
    """A closed mesh of four triangles, with normals."""
    from torchtex.meshes.mesh import Mesh

    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    return Mesh(corners, faces, normals=corners / 3**0.5)


def corner(size: int, width: int) -> Tensor:
    """True in a border of that width along the top and the left."""
    mask = torch.ones(size, size, dtype=torch.bool)
    mask[width:, width:] = False
    return mask


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Shape checks off, as users have it: the test sees the error that they see."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


class Done(NamedTuple):
    """What a command left behind."""

    code: int
    out: str
    err: str


Run = Callable[..., Done]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Iterator[Run]:
    """Runs the command line with arguments of any type."""
    from torchtex import cli

    threads = torch.get_num_threads()

    def call(*arguments: object) -> Done:
        capsys.readouterr()
        with pytest.raises(SystemExit) as caught:
            cli.main([str(argument) for argument in arguments])
        assert isinstance(caught.value.code, int)
        return Done(caught.value.code, *capsys.readouterr())

    yield call
    torch.set_num_threads(threads)


def refused(run: Run, folder: Path, words: str, *arguments: object) -> None:
    """Asserts that a command fails with one sentence that holds the words, and writes nothing."""
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    done = run(*arguments)
    assert done.code == 2, done
    assert done.out == ""
    assert done.err.startswith("torchtex: ")
    assert len(done.err.splitlines()) == 1, done.err
    assert words.lower() in done.err.lower()
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before


def pixels(path: str) -> Tensor:
    """The picture in a file."""
    from torchtex import image as images

    return images.load(path).image


@pytest.fixture(params=["pymaxflow", "ortools"])
def solver(request: pytest.FixtureRequest) -> "MinCut":
    """Each min-cut that is installed."""
    return named_solver(request.param)


def named_solver(name: str) -> "MinCut":
    """The min-cut of that name; skips the test if it is not installed."""
    from torchtex.cuts.mincut import OrTools, PyMaxflow, solvers

    if not solvers()[name]:
        pytest.skip(f"{name} is not installed")
    return PyMaxflow() if name == "pymaxflow" else OrTools()
