"""What keeps light from places: one lamp, and the sky."""

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex.meshes.cubes import cube_cutaway
from torchtex.meshes.mesh import Mesh
from torchtex.meshes.shapes import knot, sphere
from torchtex.render.scene import Thing, draw
from torchtex.render.shadows import _FACES, Lamp, Sky, _evenly, _thinned
from torchtex.render.views import Camera, Light, direction


def at(*places: tuple[float, float, float]) -> Tensor:
    return torch.tensor(places, dtype=torch.float64)


@pytest.mark.parametrize(
    ("azimuth", "elevation"), [(0.0, 0.0), (70.0, 20.0), (-130.0, -60.0), (40.0, 90.0)]
)
def test_a_ball_shades_what_lies_behind_it(azimuth: float, elevation: float) -> None:
    lamp = Lamp([sphere(24)], azimuth, elevation)
    toward = torch.tensor(direction(azimuth, elevation), dtype=torch.float64)
    aside = torch.linalg.cross(toward, at((0.3, 0.9, 0.1))[0])
    aside = aside / aside.norm()
    places = torch.stack([-2 * toward, 2 * toward, -2 * toward + 0.8 * aside, 1.3 * aside])
    assert lamp(places, torch.zeros_like(places)).tolist() == [0, 1, 0, 1]


def test_a_lamp_without_things_reaches_everything() -> None:
    assert Lamp([], 0.0, 0.0)(noise(5, 3), noise(5, 3)).tolist() == [1.0] * 5


def test_lamps_of_the_sky_are_spread_evenly() -> None:
    ways = torch.tensor([direction(*angles) for angles in _evenly(24)])
    assert ways.mean(0).abs().max() < 0.05
    cosines = (ways @ ways.T).fill_diagonal_(-1).amax(1)
    assert float(cosines.min()) > 0.7
    assert float(cosines.max()) < 0.9


def test_the_sky_is_whole_on_a_ball_and_less_in_a_corner_and_under_a_ball() -> None:
    around = sphere(24)
    assert around.normals is not None
    places = around.vertices[::50].double()
    assert Sky([around])(places, around.normals[::50].double()).min() > 0.95
    corner = Sky([cube_cutaway(0.5, side=2.0)])
    places = at((0.02, 0.02, 0.98), (0.5, 0.0, 0.5), (0.02, 0.0, 0.02))
    seen = corner(places, at((0, 1, 0)).expand(3, 3)).tolist()
    assert 0.9 > seen[0] > seen[1] - 0.2
    assert seen[1] > seen[2]
    assert seen[2] < 0.55
    below = Sky([sphere(24)])(
        at((0, -1.02, 0), (0, -1.02, 1), (0, -1.02, 6)), at((0, 1, 0)).expand(3, 3)
    )
    assert below[0] < 0.2
    assert 0.3 < below[1] < 0.95
    assert below[2] > 0.98


def test_fine_meshes_are_thinned_and_shade_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    fine = knot()
    rough = _thinned(fine)
    assert len(rough.faces) < len(fine.faces) / 2
    assert len(fine.faces) > _FACES
    small = sphere(8)
    assert _thinned(small) is small
    assert fine.normals is not None
    places, normals = fine.vertices[::97].double(), fine.normals[::97].double()
    thin = Sky([fine])(places, normals)
    monkeypatch.setattr("torchtex.render.shadows._FACES", 10**6)
    whole = Sky([fine])(places, normals)
    assert (thin - whole).abs().mean() < 0.03
    assert float(whole.min()) < 0.9
    monkeypatch.undo()
    dot = Mesh(1e-9 * noise(9000, 3).float() + 1, torch.arange(9000).view(-1, 3).repeat(3, 1))
    assert len(_thinned(dot).faces) > 0


def test_corners_are_darker_in_a_picture_and_a_single_ball_is_not() -> None:
    block = Thing(cube_cutaway(0.5, side=1.6), torch.full((1, 4, 4), 0.7), gloss=0.0)
    given = {"size": (40, 40), "samples": 2, "shadows": False}
    light, camera = Light(sky=0.6), Camera(36.0, 30.0, 4.0)
    open_ = draw([block], camera, light, corners=False, **given)  # type: ignore[arg-type]
    shaded = draw([block], camera, light, **given)  # type: ignore[arg-type]
    less = (open_ - shaded)[0]
    assert float(less.min()) > -1e-6
    assert float(less.max()) > 0.08
    ball = Thing(sphere(24), torch.full((1, 4, 4), 0.7), gloss=0.0)
    open_ = draw([ball], camera, light, corners=False, **given)  # type: ignore[arg-type]
    assert torch.allclose(draw([ball], camera, light, **given), open_, atol=0.02)  # type: ignore[arg-type]
