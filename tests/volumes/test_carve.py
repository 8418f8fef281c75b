"""Carving: trilinear, periodic samples; colours at vertices and in textures agree."""

import itertools
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import noise

from torchtex.meshes.cubes import cube
from torchtex.meshes.files import read_mesh, save_mesh
from torchtex.meshes.mesh import Mesh
from torchtex.meshes.shapes import sphere
from torchtex.render.pictures import mesh_picture
from torchtex.volumes.carve import carve, sample


def test_samples_are_trilinear_and_periodic() -> None:
    volume, places = noise(2, 3, 4, 5), 20 * noise(50, 3, seed=1) - 10
    found = sample(volume, places)
    for place, colour in zip(places, found, strict=True):
        low = place.floor().long()
        wanted = torch.zeros(2, dtype=torch.float64)
        for step in itertools.product((0, 1), repeat=3):
            at = (low + torch.tensor(step)) % torch.tensor([3, 4, 5])
            share = (1 - (place - low - torch.tensor(step)).abs()).prod()
            wanted += share * volume[:, at[0], at[1], at[2]]
        assert torch.allclose(colour, wanted)
    assert torch.allclose(sample(volume, places + torch.tensor([3.0, -4.0, 10.0])), found)
    assert sample(volume, places[:0]).shape == (0, 2)


def test_axes_are_those_of_a_picture() -> None:
    volume = torch.zeros(3, 4, 4, 4)
    volume[0, 0] = 1  # in front
    volume[1, :, 0] = 1  # above
    volume[2, :, :, 3] = 1  # to the right
    made = carve(volume, cube(), detail=0.5)
    assert made.colors is not None
    half = cube().vertices.amax()
    inner = made.vertices.abs().sort(1)[0][:, 1] < 0.4 * half  # inside of the faces
    for channel, (axis, sign) in enumerate(((2, 1), (1, 1), (0, 1))):
        at = made.vertices[:, axis] * sign
        near = made.colors[inner & (at > 0.99 * half), channel]
        far = made.colors[inner & (at.abs() < 0.2 * half), channel]
        assert near.numel()
        assert near.min() > 0.49  # half, as the surface lies between first and last voxel
        assert far.max() < 0.2


def test_a_flat_colour_stays_and_grey_becomes_rgb() -> None:
    made = carve(torch.full((1, 4, 4, 4), 0.3), sphere(8), detail=2.0)
    assert made.colors is not None
    assert made.colors.shape == (len(made.vertices), 3)
    assert torch.allclose(made.colors, torch.tensor(0.3))


def test_triangles_are_as_small_as_voxels() -> None:
    made = carve(torch.rand(3, 16, 16, 16), sphere(8), detail=1.0)
    edges = made.vertices[made.faces]
    longest = (edges - edges.roll(1, 1)).norm(dim=2).max()
    assert longest <= 2 / 16 * 1.01
    assert made.closed


def test_scale_and_shift_move_the_volume() -> None:
    volume = noise(3, 8, 8, 8, dtype=torch.float32)
    points = replace(sphere(8), faces=sphere(8).faces[:0])
    plain = carve(volume, points).colors
    assert plain is not None
    moved = carve(volume.roll((1, 2, 3), (1, 2, 3)), points, shift=(1.0, 2.0, 3.0)).colors
    assert moved is not None
    assert torch.allclose(moved, plain, atol=1e-5)
    twice = carve(volume.repeat(1, 2, 2, 2), points).colors
    scaled = carve(volume, points, scale=2.0).colors
    assert twice is not None
    assert scaled is not None
    assert torch.allclose(twice, scaled, atol=1e-5)


def test_a_baked_texture_has_the_colours_of_the_vertices() -> None:
    volume = noise(3, 4, 4, 4, dtype=torch.float32)
    made = carve(volume, sphere(6), bake=256)
    assert made.texture is not None
    assert made.uv is not None
    corners = carve(volume, Mesh(made.vertices, made.faces[:0]))
    assert corners.colors is not None
    at = (made.uv * 256 - 0.5).round().long().clamp(0, 255)  # corners lie between texels
    near = made.texture[:, at[:, 0], at[:, 1]].T
    assert (near - corners.colors).abs().mean() < 0.06
    assert made.texture.shape == (3, 256, 256)


def test_both_are_written(tmp_path: Path) -> None:
    volume = noise(3, 4, 4, 4, dtype=torch.float32)
    save_mesh(tmp_path / "a.ply", carve(volume, sphere(8)))
    save_mesh(tmp_path / "b.glb", carve(volume, sphere(8), bake=256))
    assert len(read_mesh(tmp_path / "b.glb").faces) == len(sphere(8).faces)
    assert len(read_mesh(tmp_path / "a.ply").vertices) >= len(sphere(8).vertices)


def test_a_baked_mesh_looks_like_one_with_colours(tmp_path: Path) -> None:
    volume = noise(3, 3, 3, 3, dtype=torch.float32)
    small = {"size": (32, 32), "samples": 2}
    plain = mesh_picture(carve(volume, sphere(12), detail=0.1), **small)  # type: ignore[arg-type]
    for name in ("a.glb", "a.obj"):
        save_mesh(tmp_path / name, carve(volume, sphere(12), bake=512))
        read = read_mesh(tmp_path / name)
        baked = mesh_picture(read, **small)  # type: ignore[arg-type]
        assert (plain - baked).abs().mean() < 0.01


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("scale=0.0 must be above 0", {"scale": 0.0}),
        ("detail=nan must be above 0", {"detail": float("nan")}),
        (r"bake=4 must lie in 8\.\.16384", {"bake": 4}),
        ("bake=16 is too small", {"bake": 16}),
        ("volume has 2 channels", {"volume": torch.rand(2, 4, 4, 4)}),
        ("volume holds NaN", {"volume": torch.full((3, 4, 4, 4), torch.nan)}),
        ("volume has shape", {"volume": torch.rand(4, 4, 4)}),
    ],
)
def test_bad_options_get_a_sentence(words: str, options: dict[str, object]) -> None:
    given: dict[str, object] = {"volume": torch.rand(3, 4, 4, 4), "mesh": sphere(8)} | options
    with pytest.raises(ValueError, match=words):
        carve(**given)  # type: ignore[arg-type]
