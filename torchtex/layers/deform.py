"""Deformations of a whole picture or of a layer: moved, turned, mirrored, flipped, scaled.

A deformation is an affine map about a pivot, made by kornia. What it gives is kept as positions in
the given picture, so that aligned maps can be deformed alike, and as a mask of the valid region:
where the map leads out of the picture, or of its mask, there is nothing to show.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.image import check_image
from torchtex.sources import SourceField, pixel_places

LEAST, MOST = 0.1, 10.0  # scales
_WHOLE = 1e-5  # pixels: positions so near to pixels are pixels


@dataclass(frozen=True)
class Deformation:
    """Mirrored, flipped and scaled, then turned about a pivot, then moved.

    Args:
        translate: rows down and columns to the right, in pixels.
        rotate: degrees, counter-clockwise as one sees it.
        scale: above 1 enlarges.
        mirror: left and right change places.
        flip: above and below change places.

    Raises:
        ValueError: a scale outside 0.1..10, or a number that is not finite.

    Example:
        >>> Deformation(rotate=90.0).matrix((0.0, 0.0)).round().int().tolist()
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    """

    translate: tuple[float, float] = (0.0, 0.0)
    rotate: float = 0.0
    scale: float = 1.0
    mirror: bool = False
    flip: bool = False

    def __post_init__(self) -> None:
        if not LEAST <= self.scale <= MOST:
            raise ValueError(f"scale={self.scale} must lie in {LEAST}..{MOST:g}; 1 keeps the size")
        if not all(abs(x) < 1e6 for x in (*self.translate, self.rotate)):
            raise ValueError(
                f"translate={self.translate}, rotate={self.rotate} must be finite, below a million"
            )

    def matrix(self, pivot: tuple[float, float]) -> Float[Tensor, "3 3"]:
        """Where a point (row, column, 1) goes."""
        from kornia.geometry.transform import get_affine_matrix2d

        middle = torch.tensor([pivot[::-1]], dtype=torch.float64)  # kornia counts x first
        found = get_affine_matrix2d(
            middle.new_tensor([self.translate[::-1]]),
            middle,
            middle.new_tensor([[self.scale] * 2]),
            middle.new_tensor([-self.rotate]),
        )[0]
        signs = middle.new_tensor([-1.0 if self.mirror else 1.0, -1.0 if self.flip else 1.0])
        middle = middle.T
        turned = found[:2, :2] * signs
        moved = found[:2, 2:] + found[:2, :2] @ middle - turned @ middle
        upper = torch.cat([turned, moved], 1)[[1, 0]][:, [1, 0, 2]]
        return torch.cat([upper, middle.new_tensor([[0.0, 0.0, 1.0]])])


@dataclass(frozen=True)
class Spread:
    """Ranges that deformations are drawn from, evenly.

    Args:
        rows, cols: of `translate`, in pixels.
        rotate: degrees.
        scale: drawn evenly in its logarithm.
        mirror, flip: probabilities.

    Raises:
        ValueError: an empty range, a scale outside 0.1..10, or a probability outside 0..1.

    Example:
        >>> Spread(rotate=(-30.0, 30.0)).draw(torch.Generator().manual_seed(1)).scale
        1.0
    """

    rows: tuple[float, float] = (0.0, 0.0)
    cols: tuple[float, float] = (0.0, 0.0)
    rotate: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    mirror: float = 0.0
    flip: float = 0.0

    def __post_init__(self) -> None:
        for name in ("rows", "cols", "rotate", "scale"):
            low, high = getattr(self, name)
            if not -1e6 < low <= high < 1e6:
                raise ValueError(
                    f"{name}={low}:{high} must be two finite numbers, the lesser first"
                )
        if not LEAST <= self.scale[0] <= self.scale[1] <= MOST:
            raise ValueError(
                f"scale={self.scale[0]}:{self.scale[1]} must lie in {LEAST}..{MOST:g}; "
                "1 keeps the size"
            )
        for name in ("mirror", "flip"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}={getattr(self, name)} must be a probability in 0..1")

    def draw(self, generator: torch.Generator) -> Deformation:
        """One of them."""
        drawn = torch.rand(6, generator=generator, dtype=torch.float64).tolist()

        def between(span: tuple[float, float], share: float) -> float:
            return span[0] + (span[1] - span[0]) * share

        low, high = self.scale
        return Deformation(
            (between(self.rows, drawn[0]), between(self.cols, drawn[1])),
            between(self.rotate, drawn[2]),
            min(max(low * (high / low) ** drawn[3], low), high),
            drawn[4] < self.mirror,
            drawn[5] < self.flip,
        )


@dataclass(frozen=True)
class Deformed:
    """A deformed picture.

    Args:
        texture: (c, h, w); beyond the valid region the border goes on.
        mask: the valid region.
        field: position of every pixel in the given picture.
    """

    texture: Float[Tensor, "c h w"]
    mask: Bool[Tensor, "h w"]
    field: SourceField


def deform(
    image: Float[Tensor, "c hz wz"],
    deformations: Deformation | Sequence[Deformation],
    *,
    mask: Bool[Tensor, "_ _"] | None = None,
    pivot: tuple[float, float] | None = None,
    size: tuple[int, int] | None = None,
) -> Deformed:
    """A picture, or a layer of it, after one or several deformations, read bilinearly.

    Where all positions are whole, as for mirrors and quarter turns of a square, pixels are copied.
    A picture that shrinks below 2/3 is read at several places for each pixel.

    Args:
        deformations: applied in order, all about the same pivot.
        mask: True where the picture may be used.
        pivot: row and column that scaling and turning keep; None for the middle.
        size: (height, width) of what is made; that of the picture unless given.

    Raises:
        ValueError: no image, a mask of another size, or nothing of the image is left to see.

    Source: Shen et al. 2010, Texture design by energy optimization, stage 1.

    Example:
        >>> z = torch.rand(3, 8, 8)
        >>> turned = deform(z, Deformation(rotate=90.0))
        >>> torch.equal(turned.texture, z.rot90(1, (1, 2))), bool(turned.mask.all())
        (True, True)
    """
    check_image(image)
    h, w = image.shape[1], image.shape[2]
    if mask is not None and mask.shape != (h, w):
        raise ValueError(
            f"mask is {mask.shape[0]}x{mask.shape[1]} and image {h}x{w}; give both one size"
        )
    steps = [deformations] if isinstance(deformations, Deformation) else list(deformations)
    middle = ((h - 1) / 2, (w - 1) / 2) if pivot is None else pivot
    made = warped(image, composed(steps, middle), (h, w) if size is None else size, mask)
    if not bool(made.mask.any()):
        plain = vars(Deformation())
        moved = [
            f"{name}={value}"
            for step in steps
            for name, value in vars(step).items()
            if value != plain[name]
        ]
        raise ValueError(
            f"image of {h}x{w} vanished: nothing of it can be seen after "
            f"{', '.join(moved) or 'masking'}; move it less or show more of it"
        )
    return made


def composed(deformations: Sequence[Deformation], pivot: tuple[float, float]) -> Tensor:
    """Where a point (row, column, 1) goes by several deformations, in order.

    Example:
        >>> composed([Deformation((1.0, 0.0)), Deformation(rotate=180.0)], (0.0, 0.0))[0, 2].item()
        -1.0
    """
    matrix = torch.eye(3, dtype=torch.float64)
    for step in deformations:
        matrix = step.matrix(pivot) @ matrix
    return matrix


def warped(
    image: Float[Tensor, "c hz wz"],
    matrix: Float[Tensor, "3 3"],
    size: tuple[int, int],
    mask: Bool[Tensor, "hz wz"] | None = None,
) -> Deformed:
    """A picture moved by a matrix of `composed`, in a canvas of that size.

    Example:
        >>> z = torch.rand(1, 4, 4)
        >>> torch.equal(warped(z, torch.eye(3, dtype=torch.float64), (4, 4)).texture, z)
        True
    """
    field, inside = _places(matrix, (image.shape[1], image.shape[2]), size, image.device)
    if mask is None:
        return Deformed(field.apply(image), inside, field)
    both = field.apply(torch.cat([image, mask[None].to(image)]))
    return Deformed(both[:-1], inside & (both[-1] > 1 - 1e-4), field)


def _places(
    matrix: Tensor, given: tuple[int, int], size: tuple[int, int], device: torch.device
) -> tuple[SourceField, Bool[Tensor, "h w"]]:
    """Where the pixels come from, and whether that is inside the picture."""
    from kornia.geometry.linalg import transform_points

    shrunk = float(matrix[:2, :2].det().abs().sqrt())
    samples = max(1, round(1 / shrunk))
    shifts = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
    back = torch.linalg.inv(matrix)[None]
    grid = pixel_places(size).double()
    room = torch.tensor(given, dtype=torch.float64) - 1
    layers, inside = [], torch.ones(size, dtype=torch.bool)
    for down in shifts.tolist():
        for right in shifts.tolist():
            points = grid + grid.new_tensor([down, right])
            found = transform_points(back, points.view(1, -1, 2)).view(points.shape)
            inside &= ((found > -_WHOLE) & (found < room + _WHOLE)).all(-1)
            layers.append(torch.minimum(found.clamp_min(0), room))
    places = torch.stack(layers)
    nearest = places.round()
    whole = bool(((places - nearest).abs() < _WHOLE).all())
    positions = F.pad(nearest.long() if whole else places.float(), (1, 0)).to(device)
    weights = torch.full(positions.shape[:3], 1 / len(layers), device=device)
    return SourceField(positions, weights, (given,)), inside.to(device)
