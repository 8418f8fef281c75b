"""Shapes, light and whole pictures."""

import math
from pathlib import Path

import pytest
import torch
from conftest import noise, spots

from torchtex.render.pictures import (
    OBJECTS,
    VIEWS,
    mesh_picture,
    solid,
    texture_picture,
    volume_picture,
)
from torchtex.render.scene import Thing, draw, normal_map
from torchtex.render.shapes import Mesh, plane, sphere, torus, vase
from torchtex.render.solids import cube, cube_cutaway, load_mesh, wrapped
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


# --------------------------------------------------------------------------------- shapes


@pytest.mark.parametrize("name", list(OBJECTS))
def test_things_face_outwards_with_rows_down_and_columns_to_the_right(name: str) -> None:
    mesh = OBJECTS[name]()
    assert mesh.normals is not None
    assert mesh.uv is not None
    corners = mesh.vertices[mesh.faces].double()
    a, b, c = corners.unbind(1)
    face = torch.linalg.cross(b - a, c - a)
    area = face.norm(dim=1)
    smooth = mesh.normals[mesh.faces].double().mean(1)
    assert bool(((face * smooth).sum(1) >= -1e-9).all())
    assert torch.allclose(mesh.normals.norm(dim=1), torch.ones(len(mesh.normals)), atol=1e-3)
    p, q, r = mesh.uv[mesh.faces].double().unbind(1)
    first, second = q - p, r - p
    turned = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    assert bool((turned[area > 1e-9] > 0).all())  # no texture is mirrored


@pytest.mark.parametrize("mesh", [sphere(24), torus(24), cube(), cube_cutaway(0.3)])
def test_closed_things_are_closed(mesh: Mesh) -> None:
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    flux = torch.linalg.cross(b - a, c - a).sum(0)
    assert float(flux.abs().max()) < 1e-5
    volume = float((a * torch.linalg.cross(b, c)).sum() / 6)
    assert volume > 0


def test_a_cut_takes_its_corner_away() -> None:
    mesh = cube_cutaway(0.4, side=2.0)
    assert mesh.places is not None
    assert not bool((mesh.places > 0.6 + 1e-6).all(1).any())
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    volume = float((a * torch.linalg.cross(b, c)).sum() / 6)
    assert volume == pytest.approx(8 * (1 - 0.4**3), rel=1e-5)
    assert torch.allclose((mesh.places - 0.5) * 2, mesh.vertices)
    with pytest.raises(ValueError, match=r"cut=1\.0"):
        cube_cutaway(1.0)


def test_a_vase_stands_upright() -> None:
    low, high = vase().vertices.amin(0), vase().vertices.amax(0)
    assert float(high[1]) == pytest.approx(1)
    assert float(low[1]) == pytest.approx(-1)
    assert float((high + low)[[0, 2]].abs().max()) < 0.01


@pytest.mark.usefixtures("unchecked")
def test_meshes_that_make_no_sense_get_one_sentence() -> None:
    v, f = torch.rand(3, 3), torch.tensor([[0, 1, 2]])
    with pytest.raises(ValueError, match=r"vertices outside 0\.\.2"):
        Mesh(v, f + 1)
    with pytest.raises(ValueError, match="faces is empty"):
        Mesh(v, f[:0])
    with pytest.raises(ValueError, match="uv has 2 rows for 3"):
        Mesh(v, f, torch.rand(2, 2))
    with pytest.raises(ValueError, match="NaN"):
        Mesh(v * math.nan, f)
    with pytest.raises(ValueError, match="no places on a texture"):
        Thing(Mesh(v, f), torch.rand(3, 4, 4))


def test_meshes_from_files_keep_colours_and_fit(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    ball = sphere(6)
    colors = ((ball.vertices + 1) * 127).round().byte().numpy()
    made = trimesh.Trimesh(5 * ball.vertices.numpy() + 9, ball.faces.numpy(), process=False)
    made.visual.vertex_colors = colors
    for name in ("a.ply", "a.glb"):
        made.export(tmp_path / name)
        mesh = load_mesh(tmp_path / name)
        assert mesh.colors is not None
        assert float(mesh.vertices.norm(dim=1).max()) == pytest.approx(1)
        assert float((mesh.colors * 255 - torch.tensor(colors)).abs().max()) < 1.5
        assert wrapped(mesh).uv is not None
    (tmp_path / "b.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
                                    "f 1/1 2/2 3/3\n")  # fmt: skip
    mesh = load_mesh(tmp_path / "b.obj")
    assert mesh.uv is not None
    assert mesh.uv.tolist() == [[1, 0], [1, 1], [0, 0]]
    (tmp_path / "c.obj").write_text("nothing")
    (tmp_path / "d.ply").write_bytes(b"\0\1")
    for name, words in (("c.obj", "mesh"), ("d.ply", "no mesh that can be read"),
                        ("e.obj", "cannot be read"), ("f.png", "must end in")):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            load_mesh(tmp_path / name)


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
    read = load_mesh(tmp_path / "a.glb")
    assert read.texture is not None
    assert read.uv is not None
    assert torch.allclose(read.uv, mesh.uv)
    shown = mesh_picture(read, gloss=0.0, light=FLAT, size=(9, 9), samples=1)
    assert torch.allclose(shown[:, 4, 4], torch.tensor([10.0, 200.0, 10.0]) / 255, atol=0.05)


def test_wrapping_has_no_seam_inside_a_triangle() -> None:
    ball = wrapped(Mesh(sphere(12).vertices, sphere(12).faces))
    assert ball.uv is not None
    across = ball.uv[ball.faces][..., 1]
    assert float((across.amax(1) - across.amin(1)).max()) <= 1 + 1e-6


# --------------------------------------------------------------------------------- light


def test_a_wall_from_the_front_shows_its_texture() -> None:
    texture = noise(3, 24, 24).float()
    shown = draw([Thing(wall(), texture, gloss=0.0)], front(), FLAT, (24, 24), samples=1)
    assert torch.allclose(shown, texture, atol=2e-3)
    solidly = Thing(wall(), color=lambda p: torch.stack([p[:, 0] / 2 + 0.5] * 3, 1), gloss=0.0)
    shown = draw([solidly], front(), FLAT, (24, 24), samples=2)
    wanted = ((torch.arange(24) + 0.5) / 24).expand(3, 24, 24)
    assert torch.allclose(shown, wanted, atol=5e-3)


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


@pytest.mark.parametrize("name", list(OBJECTS))
def test_every_thing_shows_in_the_middle_of_its_picture(name: str) -> None:
    red = torch.tensor([0.8, 0.1, 0.1])[:, None, None].expand(3, 8, 8)
    shown = texture_picture(red, name, **SMALL)  # type: ignore[arg-type]
    reddish = shown[0] > 2 * shown[1]
    assert bool(reddish[12 if name != "torus" else 17, 12])
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
        ("thing='cone' is unknown", {"thing": "cone"}),
        (r"tiles=0\.0 must be", {"tiles": 0.0}),
        (r"normals=nan", {"normals": math.nan}),
        (r"gloss=-1\.0", {"gloss": -1.0}),
        (r"size=\(0, 4\)", {"size": (0, 4)}),
        (r"samples=9", {"samples": 9}),
    ):
        with pytest.raises(ValueError, match=words):
            texture_picture(texture, **given)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="elevation=90"):
        Camera(0.0, 90.0)
    with pytest.raises(ValueError, match="distance=0"):
        Camera(distance=0.0)
    with pytest.raises(ValueError, match="fov=0"):
        Camera(fov=0.5)
    with pytest.raises(ValueError, match="sky=-1"):
        Light(sky=-1.0)
    with pytest.raises(ValueError, match="things is empty"):
        draw([], Camera(), Light(), (4, 4))
    assert direction(90.0, 0.0) == pytest.approx((1.0, 0.0, 0.0))
