"""Light and whole pictures."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import noise, spots

from torchtex.meshes.files import read_mesh
from torchtex.meshes.mesh import Mesh
from torchtex.meshes.shapes import SHAPES, plane, sphere
from torchtex.render.pictures import (
    VIEWS,
    mesh_picture,
    solid,
    texture_picture,
    volume_picture,
)
from torchtex.render.relief import normal_map
from torchtex.render.scene import Thing, draw
from torchtex.render.views import Camera, Light, direction

FLAT = Light(0.0, 0.0, strength=0.0, sky=1.25)  # 1 for normals to the front
SMALL = {"size": (24, 24), "samples": 1}


def wall(side: float = 2.0) -> Mesh:
    """A square that faces the viewer, one tile on it."""
    corners = torch.tensor([[-1.0, 1, 0], [1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * side / 2
    uv = torch.tensor([[0.0, 0], [0, 1], [1, 0], [1, 1]])
    return Mesh(corners, torch.tensor([[0, 2, 1], [1, 2, 3]]), uv)


def front(fov: float = 2 * math.degrees(math.atan(0.25))) -> Camera:
    """A camera that a wall of side 2 fills exactly."""
    return Camera(0.0, 0.0, 4.0, fov=fov)


def test_what_cannot_be_shown_gets_one_sentence() -> None:
    v, f = torch.rand(3, 3), torch.tensor([[0, 1, 2]])
    with pytest.raises(ValueError, match="no triangles"):
        Thing(Mesh(v, f[:0]))
    with pytest.raises(ValueError, match="no places on a texture"):
        Thing(Mesh(v, f), torch.rand(3, 4, 4))


def test_a_mesh_is_moved_before_the_usual_camera() -> None:
    far = replace(sphere(8), vertices=1e-3 * sphere(8).vertices + 7)
    shown = mesh_picture(far, size=(24, 24), samples=1)
    near = mesh_picture(sphere(8), size=(24, 24), samples=1)
    assert torch.allclose(shown, near, atol=0.02)
    texture = noise(3, 8, 8).float()
    shown = texture_picture(texture, far, size=(24, 24), samples=1)
    assert (shown - texture_picture(texture, "sphere", size=(24, 24), samples=1)).abs().mean() < 0.1


def test_a_texture_that_a_file_holds_is_shown(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    from PIL import Image

    mesh = wall()
    assert mesh.uv is not None
    green = Image.new("RGB", (8, 8), (10, 200, 10))
    uv = torch.stack([mesh.uv[:, 1], 1 - mesh.uv[:, 0]], 1).numpy()
    made = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    made.visual = trimesh.visual.TextureVisuals(uv=uv, image=green)
    made.export(tmp_path / "a.glb")
    read = read_mesh(tmp_path / "a.glb")
    assert read.texture is not None
    assert read.uv is not None
    assert torch.allclose(read.uv, mesh.uv)
    shown = mesh_picture(read, gloss=0.0, light=FLAT, size=(9, 9), samples=1)
    assert torch.allclose(shown[:, 4, 4], torch.tensor([10.0, 200.0, 10.0]) / 255, atol=0.05)


# --------------------------------------------------------------------------------- light


def test_a_wall_from_the_front_shows_its_texture() -> None:
    texture = noise(3, 24, 24).float()
    shown = draw([Thing(wall(), texture, gloss=0.0)], front(), FLAT, (24, 24), samples=1)
    assert torch.allclose(shown, texture, atol=2e-3)
    solidly = Thing(wall(), color=lambda p: torch.stack([p[:, 0] / 2 + 0.5] * 3, 1), gloss=0.0)
    shown = draw([solidly], front(), FLAT, (24, 24), samples=2)
    wanted = ((torch.arange(24) + 0.5) / 24).expand(3, 24, 24)
    assert torch.allclose(shown, wanted, atol=5e-3)


def test_a_camera_straight_above_sees_its_azimuth_below() -> None:
    for azimuth in (0.0, 30.0, -100.0):
        toward = direction(azimuth, 0.0)
        points = torch.tensor([(0.0, 0.0, 0.0), toward], dtype=torch.float64)
        x, y, depth = Camera(azimuth, 90.0, 4.0).seen(points, (9, 9)).unbind(1)
        assert torch.allclose(x / depth, torch.full((2,), 4.0, dtype=torch.float64))
        assert float(y[0] / depth[0]) == pytest.approx(4.0)
        assert float(y[1] / depth[1]) > 5


def test_lambert_and_the_sky() -> None:
    white = Thing(wall(), torch.ones(1, 4, 4), gloss=0.0)
    for elevation in (0.0, 60.0):
        lit = draw([white], front(), Light(0.0, elevation, 0.7, 0.1), (8, 8), samples=1)
        wanted = (0.7 * math.cos(math.radians(elevation)) + 0.08) ** (1 / 2.2)
        assert torch.allclose(lit, torch.full((3, 8, 8), wanted), atol=1e-3)
    shiny = Thing(wall(), torch.zeros(1, 4, 4), gloss=1.0)
    lit = draw([shiny], front(), Light(0.0, 0.0, 1.0, 0.0), (9, 9), samples=1)
    assert float(lit[0, 4, 4]) > float(lit[0, 0, 0]) > 0


def test_a_ball_throws_a_shadow_on_the_ground() -> None:
    floor = Thing(plane(8.0), torch.full((1, 4, 4), 0.8), gloss=0.0, shadow=False)
    ball = Thing(sphere(16), torch.ones(1, 4, 4))
    camera = Camera(0.0, 60.0, 8.0)
    lamp = Light(90.0, 40.0, 0.9, 0.1)
    things = [floor, ball]
    dark = draw(things, camera, lamp, (48, 48), samples=1)
    plain = draw(things, camera, lamp, (48, 48), samples=1, shadows=False)
    changed = (plain - dark).amax(0)
    assert float(changed.min()) > -1e-6
    _, cols = (changed > 0.2).nonzero().unbind(1)
    assert len(cols) > 20
    assert float(cols.double().mean()) < 20  # the light comes from the right
    assert float((changed[:, 34:] > 0.05).double().mean()) == 0


def test_normal_maps_point_uphill_away_from_the_slope() -> None:
    bump = spots(32)
    normals = normal_map(bump, 1.0)
    assert normals.shape == (3, 32, 32)
    assert torch.allclose(normals.norm(dim=0), torch.ones(32, 32, dtype=torch.float64))
    ramp = torch.arange(16).double().expand(1, 16, 16) / 20
    right, down = normal_map(ramp), normal_map(ramp.transpose(1, 2))
    assert float(right[0, 8, 8]) < 0
    assert abs(float(right[1, 8, 8])) < 1e-9
    assert float(down[1, 8, 8]) > 0  # y is up, and light is at the bottom
    assert torch.allclose(normal_map(ramp, -1.0)[0], -right[0])
    assert torch.allclose(normal_map(bump.roll(5, 2)), normals.roll(5, 2))


def test_relief_is_lit_from_the_side_that_the_light_is_on() -> None:
    hump = torch.exp(-((torch.arange(32) - 15.5) ** 2) / 30).double().expand(1, 32, 32)
    thing = Thing(wall(), torch.full((1, 32, 32), 0.5), normals=normal_map(hump).float(), gloss=0.0)
    lit = draw([thing], front(), Light(80.0, 0.0, 1.0, 0.0), (32, 32), samples=1, shadows=False)
    assert float(lit[0, 16, 19]) > float(lit[0, 16, 12]) + 0.2
    turned = Thing(thing.mesh, thing.texture, normals=normal_map(hump.transpose(1, 2)).float())
    lit = draw([turned], front(), Light(0.0, 80.0, 1.0, 0.0), (32, 32), samples=1, shadows=False)
    assert float(lit[0, 12, 16]) > float(lit[0, 19, 16]) + 0.2


# --------------------------------------------------------------------------------- pictures


@pytest.mark.parametrize("name", list(SHAPES))
def test_every_thing_shows_in_the_middle_of_its_picture(name: str) -> None:
    red = torch.tensor([0.8, 0.1, 0.1])[:, None, None].expand(3, 8, 8)
    shown = texture_picture(red, name, **SMALL)  # type: ignore[arg-type]
    reddish = shown[0] > 2 * shown[1]
    row = {"torus": 17, "knot": 14}.get(name, 12)
    assert bool(reddish[row, 12])
    if name != "plane":
        border = torch.cat([reddish[0], reddish[-1], reddish[:, 0], reddish[:, -1]])
        assert not bool(border.any())
    assert name in VIEWS


def test_more_samples_are_the_mean_of_samples_and_bands_change_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    texture = noise(3, 16, 16).float()
    fine = texture_picture(texture, "torus", normals=1.0, ground=texture, size=(20, 30), samples=2)
    monkeypatch.setattr("torchtex.render.scene._SAMPLES", 200)
    again = texture_picture(texture, "torus", normals=1.0, ground=texture, size=(20, 30), samples=2)
    assert torch.allclose(fine, again, atol=1e-6)
    torch.set_num_threads(2)
    again = texture_picture(texture, "torus", normals=1.0, ground=texture, size=(20, 30), samples=2)
    assert torch.allclose(fine, again, atol=1e-6)


def test_grey_and_many_channels_are_shown() -> None:
    grey = noise(1, 8, 8).float()
    shown = texture_picture(grey, "cube", **SMALL)  # type: ignore[arg-type]
    assert shown.shape == (3, 24, 24)
    many = torch.cat([grey.expand(3, -1, -1), noise(4, 8, 8).float()])
    assert torch.equal(texture_picture(many, "cube", **SMALL), shown)  # type: ignore[arg-type]


def test_a_volume_shows_its_slices() -> None:
    volume = torch.zeros(3, 8, 6, 4)
    volume[0, 0], volume[1, :, 0], volume[2, :, :, -1] = 1.0, 1.0, 1.0
    color = solid(volume)
    spots = torch.tensor([[0.3, 0.5, 1.0], [0.3, 1.0, 0.3], [1.0, 0.5, 0.3], [0.3, 0.3, 0.3]])
    assert color(spots).round().tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]]
    whole = volume_picture(volume, cut=None, **SMALL)  # type: ignore[arg-type]
    cut = volume_picture(volume, cut=0.5, **SMALL)  # type: ignore[arg-type]
    assert float((whole - cut).abs().max()) > 0.3


def test_a_mesh_shows_the_colours_of_its_vertices() -> None:
    mesh = wall()
    red = torch.tensor([[1.0, 0.0, 0.0]]).expand(4, 3)
    painted = Mesh(mesh.vertices, mesh.faces, colors=red)
    shown = mesh_picture(painted, gloss=0.0, camera=front(), light=FLAT, size=(8, 8), samples=1)
    assert torch.allclose(shown, red[0][:, None, None].expand(3, 8, 8), atol=1e-6)


def test_bad_arguments_get_one_sentence() -> None:
    texture = torch.rand(3, 8, 8)
    for words, given in (
        ("thing='teapot' is unknown", {"thing": "teapot"}),
        (r"tiles=0\.0 must be", {"tiles": 0.0}),
        (r"normals=nan", {"normals": math.nan}),
        (r"gloss=-1\.0", {"gloss": -1.0}),
        (r"size=\(0, 4\)", {"size": (0, 4)}),
        (r"samples=9", {"samples": 9}),
    ):
        with pytest.raises(ValueError, match=words):
            texture_picture(texture, **given)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"elevation=90\.5 must lie in -90\.\.90"):
        Camera(0.0, 90.5)
    with pytest.raises(ValueError, match="elevation=-91"):
        Light(0.0, -91.0)
    with pytest.raises(ValueError, match="distance=0"):
        Camera(distance=0.0)
    with pytest.raises(ValueError, match="fov=0"):
        Camera(fov=0.5)
    with pytest.raises(ValueError, match="sky=-1"):
        Light(sky=-1.0)
    with pytest.raises(ValueError, match="things is empty"):
        draw([], Camera(), Light(), (4, 4))
    assert direction(90.0, 0.0) == pytest.approx((1.0, 0.0, 0.0))
