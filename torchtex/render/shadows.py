"""What keeps light from a place: things as lamps far away see them, one lamp or many.

Source: Williams 1978, Casting curved shadows on curved surfaces; Landis 2002 for the sky.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.meshes.mesh import Mesh, joined
from torchtex.render.raster import rasterize
from torchtex.render.views import Camera, direction

_SHARP, _ROUGH = 768, 112  # pixels, of the sides of the depth maps of a lamp and of the sky's
_LAMPS = 24  # of the sky
_CELLS = 40  # along the longest side, of meshes before the sky
_FACES = 6000  # more than these are thinned out before it
_BOUNCE = 0.4  # of the light that does not come from the sky, what comes from things around


class Lamp:
    """How much of the light of a lamp far away reaches places.

    Args:
        meshes: what stands in its way.
        azimuth, elevation: where it is, in degrees.
        side: of its depth map, in pixels.
        lift: share of the things' radius that a place is moved along its normal, so that nothing
            shades itself.
        taps: pixels of the depth map beside the place that are looked at, each way.

    Example:
        >>> wall = Mesh(torch.tensor([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]]), torch.arange(3)[None])
        >>> places = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        >>> Lamp([wall], 0.0, 0.0)(places, torch.zeros_like(places)).tolist()
        [0.0, 1.0]
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        azimuth: float,
        elevation: float,
        *,
        side: int = _SHARP,
        lift: float = 0.02,
        taps: tuple[float, ...] = (-2.25, -0.75, 0.75, 2.25),
    ) -> None:
        self.side, self.taps = side, taps
        self.depth: Tensor | None = None
        if not meshes:
            return
        whole = joined([Mesh(mesh.vertices, mesh.faces) for mesh in meshes])
        middle = (whole.vertices.amin(0) + whole.vertices.amax(0)) / 2
        radius = float((whole.vertices - middle).norm(dim=1).max()) * 1.02
        a, b, c = middle.tolist()
        fov = math.degrees(2 * math.asin(1 / 12))
        self.camera = Camera(azimuth, elevation, 12 * radius, (a, b, c), fov)
        self.lift = lift * radius
        seen = self.camera.seen(whole.vertices, (side, side))
        self.depth = rasterize(seen, whole.faces, (side, side)).depth

    def __call__(
        self, place: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n"]:
        """The share of its light, from 0 to 1, with a soft edge."""
        if self.depth is None:
            return torch.ones(len(place), dtype=torch.float64, device=place.device)
        lifted, most = place + self.lift * normal, self.side - 1
        x, y, w = self.camera.seen(lifted, (self.side, self.side)).unbind(1)
        column, row = x / w, y / w
        total = torch.zeros_like(w)
        for down in self.taps:
            for right in self.taps:
                i, j = (row + down).round().long(), (column + right).round().long()
                inside = (i >= 0) & (i <= most) & (j >= 0) & (j <= most)
                nearest = self.depth[i.clamp(0, most), j.clamp(0, most)]
                total += (~inside | (nearest * w <= 1 + 1e-6)).double()
        return total / len(self.taps) ** 2


class Sky:
    """How much of the light from all around reaches places: less in corners and under things.

    Args:
        meshes: what stands in its way.

    Example:
        >>> from torchtex.meshes.shapes import sphere
        >>> place = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64)
        >>> Sky([sphere(8)])(place, place).item()
        1.0
    """

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        rough = [_thinned(mesh) for mesh in meshes]
        self.lamps = [
            (
                direction(azimuth, elevation),
                Lamp(rough, azimuth, elevation, side=_ROUGH, lift=0.05, taps=(-1.0, 0.0, 1.0)),
            )
            for azimuth, elevation in _evenly(_LAMPS)
        ]

    def __call__(
        self, place: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n"]:
        """Its share, from 0 to 1, by how places face it, and with what things around give back."""
        reached, whole = place.new_zeros(len(place)), place.new_zeros(len(place))
        for toward, lamp in self.lamps:
            facing = (normal @ normal.new_tensor(toward)).clamp(min=0)
            here = facing.nonzero()[:, 0]
            whole += facing
            reached[here] += facing[here] * lamp(place[here], normal[here])
        open_ = reached / whole.clamp(min=1e-12)
        return open_ / (1 - _BOUNCE * (1 - open_))


def _thinned(mesh: Mesh) -> Mesh:
    """The mesh with one vertex in every cell of a grid, if it has many faces."""
    if len(mesh.faces) <= _FACES:
        return mesh
    low = mesh.vertices.amin(0)
    step = (mesh.vertices - low).max().clamp(min=1e-30) / _CELLS
    cells = ((mesh.vertices - low) / step).round()
    places, number = torch.unique(cells, dim=0, return_inverse=True)
    faces = number[mesh.faces]
    whole = (faces != faces.roll(1, 1)).all(1)
    if not bool(whole.any()):
        return mesh
    return Mesh(places * step + low, torch.unique(faces[whole], dim=0))


def _evenly(count: int) -> list[tuple[float, float]]:
    """Azimuth and elevation of points spread evenly over a sphere, on a spiral."""
    turn = 180 * (3 - math.sqrt(5))
    heights = [1 - (2 * number + 1) / count for number in range(count)]
    return [
        ((turn * number + 180) % 360 - 180, math.degrees(math.asin(height)))
        for number, height in enumerate(heights)
    ]
