"""Rasteriser: against rays, against brute force, and textures read at the right scale."""

import pytest
import torch
from conftest import noise
from torch import Tensor

from torchtex.render.raster import mipmaps, rasterize
from torchtex.render.views import Camera


def soup(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Random triangles, some of which pass the camera."""
    vertices = noise(3 * count, 3, seed=seed) * torch.tensor([30.0, 30.0, 3.0]) - 0.5
    depth = vertices[:, 2:] - 0.4
    return torch.cat([vertices[:, :2] * depth, depth], 1), torch.arange(3 * count).view(-1, 3)


def by_rays(seen: Tensor, faces: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The nearest triangle on the ray of each pixel, one ray and one triangle at a time."""
    found = torch.full(size, -1)
    nearest = torch.full(size, torch.inf, dtype=torch.float64)
    for number, face in enumerate(faces.tolist()):
        corners = seen[face].T  # ray = corners @ weights, up to a factor
        for row in range(size[0]):
            for column in range(size[1]):
                ray = torch.tensor([column, row, 1.0], dtype=torch.float64)
                weights = torch.linalg.solve(corners, ray)
                if bool((weights >= 0).all()):
                    depth = 1 / float(weights.sum())
                    if 1e-3 < depth < float(nearest[row, column]):
                        nearest[row, column] = depth
                        found[row, column] = number
    return found, nearest


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_pixel_shows_the_triangle_that_its_ray_meets_first(seed: int) -> None:
    seen, faces = soup(12, seed)
    hits = rasterize(seen, faces, (12, 14))
    found, nearest = by_rays(seen, faces, (12, 14))
    assert int((found >= 0).sum()) > 20
    assert torch.equal(hits.triangle, found)
    here = found >= 0
    assert torch.allclose(1 / hits.depth[here], nearest[here])
    assert float(hits.depth[~here].sum()) == 0
    weights = hits.weights(hits.pixels())
    assert torch.allclose(weights.sum(1), torch.ones(len(weights), dtype=torch.float64))
    where = (seen[faces[found[here]]] * weights[..., None]).sum(1)
    at = where[:, :2] / where[:, 2:]
    assert torch.allclose(at, hits.pixels().flip(1).double(), atol=1e-9)


def test_bands_of_rows_are_parts_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, faces = soup(20, 5)
    whole = rasterize(seen, faces, (16, 10))
    parts = [rasterize(seen, faces, (16, 10), rows=(a, a + 4)) for a in range(0, 16, 4)]
    assert torch.equal(torch.cat([part.triangle for part in parts]), whole.triangle)
    pixels = parts[2].pixels()
    below = pixels + torch.tensor([8, 0])
    assert torch.allclose(parts[2].weights(pixels), whole.weights(below))
    monkeypatch.setattr("torchtex.render.raster._PAIRS", 7)
    assert torch.equal(rasterize(seen, faces, (16, 10)).triangle, whole.triangle)


def test_places_on_a_floor_are_where_the_rays_meet_it() -> None:
    camera = Camera(30.0, 25.0, 3.0, fov=50.0)
    corners = torch.tensor([[-9.0, 0, -9], [9, 0, -9], [-9, 0, 9], [9, 0, 9]], dtype=torch.float64)
    faces = torch.tensor([[0, 2, 1], [1, 2, 3]])
    hits = rasterize(camera.seen(corners, (40, 40)), faces, (40, 40))
    pixels = hits.pixels()
    triangle = hits.triangle[pixels[:, 0], pixels[:, 1]]
    place = (corners[faces[triangle]] * hits.weights(pixels)[..., None]).sum(1)
    assert float(place[:, 1].abs().max()) < 1e-9
    seen = camera.seen(place, (40, 40))
    assert torch.allclose(seen[:, :2] / seen[:, 2:], pixels.flip(1).double(), atol=1e-8)
    assert int((hits.triangle[20:] >= 0).sum()) == 20 * 40  # also where it passes the camera


def test_triangles_seen_from_their_edge_and_behind_the_camera_do_not_show() -> None:
    flat = torch.tensor([[1.0, 1, 1], [5, 5, 1], [9, 9, 1]])
    behind = torch.tensor([[1.0, 1, -1], [5, 5, -1], [9, 1, -1]])
    for seen in (flat, behind):
        assert int(rasterize(seen, torch.tensor([[0, 1, 2]]), (8, 8)).triangle.max()) == -1


def test_textures_repeat_and_are_exact_in_the_middle_of_their_pixels() -> None:
    texture = noise(3, 5, 7)
    at = torch.tensor([[(2 + 0.5) / 5 - 3, (6 + 0.5) / 7 + 2]], dtype=torch.float64)
    assert torch.allclose(mipmaps(texture)(at)[0], texture[:, 2, 6])
    none = torch.zeros(1, 2, dtype=torch.float64)
    assert torch.allclose(mipmaps(texture)(at, none, none)[0], texture[:, 2, 6])


def test_fine_patterns_far_away_are_their_mean_and_not_noise() -> None:
    board = (torch.arange(16)[:, None] + torch.arange(16)) % 2
    texture = board.double()[None]
    at = noise(200, 2)
    far = torch.tensor([[4.0, 0.0]], dtype=torch.float64).expand(200, 2)
    assert float((mipmaps(texture)(at, far, far.flip(1)) - 0.5).abs().max()) < 1e-6
    # long footprints: rows fade, columns stay
    stripes = (torch.arange(16) % 4 < 2).double().expand(16, 16)[None]
    long = torch.tensor([[0.5, 0.0]], dtype=torch.float64).expand(200, 2)
    thin = torch.tensor([[0.0, 1 / 16]], dtype=torch.float64).expand(200, 2)
    exact = mipmaps(stripes)(at)
    assert torch.allclose(mipmaps(stripes)(at, long, thin), exact, atol=0.05)
    assert torch.allclose(mipmaps(stripes)(at, thin, long), exact, atol=0.05)
