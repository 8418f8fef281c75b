"""Pictures marbled by a list of operations, and taken back.

The maps of all operations are put together first, and the image is read once, through a spline.
Where the paint is drawn out, one output pixel is the mean of several readings; where it is not,
the reading in its middle is all there is, so that little is lost when a picture is taken back.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.image import check_image
from torchtex.layers.resampling import Spline, fit
from torchtex.layers.tines import Operation, Size
from torchtex.layers.whirls import Drop

_PIXELS = 2**16  # read at a time
_STEPS = ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
_DULL = 0.1  # blur, in output pixels, that is not worth more readings


def marble(
    image: Float[Tensor, "c hz wz"],
    operations: Sequence[Operation],
    *,
    periodic: bool = False,
    undo: bool = False,
    size: tuple[int, int] | None = None,
    samples: int = 4,
    degree: int = 3,
) -> Float[Tensor, "c h w"]:
    """The image after the operations, the first one first.

    Differentiable in the image and in the operations' numbers. On a periodic image the result
    is periodic too.

    Args:
        image: (c, h, w) in [0, 1].
        operations: such as those of `tines` and `whirls`.
        periodic: the image is a tile, and stays one; otherwise what comes in from outside is
            the image mirrored at its borders.
        undo: take back what the same operations did; the ink of drops is taken up.
        size: (height, width) of the result; that of the image unless given. A design fits any.
        samples: where the paint is drawn out, a pixel is the mean of this number squared.
        degree: of the spline that the image is read through; 5 and 7 keep more detail, and ring
            a little beside hard edges.

    Raises:
        ValueError: an image, size or number of samples that is none, an operation that does not
            fit a periodic image, or ink of another number of channels.

    Example:
        >>> from torchtex.layers.tines import Tine
        >>> design = [Drop(color=(0.2,)), Tine(90.0, shift=0.1)]
        >>> marble(torch.rand(1, 32, 32), design, periodic=True).shape
        torch.Size([1, 32, 32])
    """
    check_image(image)
    h, w = (image.shape[1], image.shape[2]) if size is None else size
    if h < 1 or w < 1:
        raise ValueError(f"size={(h, w)} must be at least 1 x 1")
    if not 1 <= samples <= 16:
        raise ValueError(f"samples={samples} must lie in 1..16")
    for operation in operations:
        color = operation.color if isinstance(operation, Drop) else None
        if color is not None and len(color) != len(image):
            raise ValueError(
                f"color={color} has {len(color)} values and the image {len(image)} channels; "
                "give one each"
            )
    read = _Reader(
        fit(image, periodic=periodic, degree=degree),
        tuple(operations),
        undo,
        (image.shape[1] / h, image.shape[2] / w),
    )
    rows, columns = (
        torch.arange(extent, dtype=torch.float64, device=image.device) for extent in (h, w)
    )
    parts = []
    lines = max(1, _PIXELS // w)
    for some in rows.split(lines):
        pixel = torch.stack(torch.meshgrid(some, columns, indexing="ij")).flatten(1)
        parts.append(read.pixels(pixel, samples).view(len(image), len(some), w))
    return torch.cat(parts, 1).clamp(0, 1)


def trace(
    operations: Sequence[Operation],
    place: Float[Tensor, "2 n"],
    size: Size,
    *,
    periodic: bool = False,
    undo: bool = False,
) -> tuple[Float[Tensor, "2 n"], Int[Tensor, "n"]]:
    """Where what lies at each place came from, and in the ink of which drop, -1 for none.

    Args:
        place: (row, column) in pixels of a texture of `size`.
        undo: where it went instead.

    Example:
        >>> from torchtex.layers.tines import Tine
        >>> at = torch.tensor([[1.5, 0.0], [1.5, 0.0]])
        >>> trace([Tine(), Drop(radius=0.25, color=(1.0,))], at, (4, 4))[1].tolist()
        [1, -1]
    """
    ink = torch.full(place.shape[1:], -1, dtype=torch.long, device=place.device)
    if undo:
        for operation in operations:
            place = operation.forward(place, size, periodic)
        return place, ink
    for number in reversed(range(len(operations))):
        operation = operations[number]
        before = operation.back(place, size, periodic)
        if isinstance(operation, Drop):
            here = operation.covers(place, size, periodic)
            ink = torch.where(here & (ink < 0), number, ink)
        place = torch.where(ink < 0, before, place)
    return place, ink


class _Reader:
    """Colours of output pixels."""

    def __init__(
        self,
        spline: Spline,
        operations: tuple[Operation, ...],
        undo: bool,
        step: tuple[float, float],
    ) -> None:
        self.spline, self.operations, self.undo, self.step = spline, operations, undo, step
        coefficients = spline.coefficients
        self.size = (coefficients.shape[1], coefficients.shape[2])

    def pixels(self, pixel: Tensor, samples: int) -> Tensor:
        """(c, n): each the mean over as much of it as its image is drawn out."""
        place, ink = self._trace(pixel)
        color = self._read(place, ink)
        if samples == 1 or self.undo:  # what is squeezed again is smooth
            return color
        with torch.no_grad():
            share = self._spread(pixel)
            chosen = (share > _DULL).nonzero()[:, 0]
        if not len(chosen):
            return color
        middle = (torch.arange(samples, dtype=torch.float64, device=pixel.device) + 0.5) / samples
        total = torch.zeros_like(color[:, chosen])
        for down in middle - 0.5:
            for right in middle - 0.5:
                offset = torch.stack([down, right])[:, None] * share[chosen]
                total = total + self._read(*self._trace(pixel[:, chosen] + offset))
        return color.index_copy(1, chosen, total / samples**2)

    def _trace(self, pixel: Tensor) -> tuple[Tensor, Tensor]:
        scale = torch.tensor(self.step, dtype=torch.float64, device=pixel.device)[:, None]
        place = (pixel + 0.5) * scale - 0.5
        return trace(
            self.operations, place, self.size, periodic=self.spline.periodic, undo=self.undo
        )

    def _read(self, place: Tensor, ink: Tensor) -> Tensor:
        color = self.spline(place)
        for number, operation in enumerate(self.operations):
            if isinstance(operation, Drop) and operation.color is not None:
                own = color.new_tensor(operation.color)[:, None]
                color = torch.where(ink == number, own, color)
        return color

    def _spread(self, pixel: Tensor) -> Tensor:
        """How much of each pixel's extent is to be read: 0 where its image is no larger."""
        ends = [self._trace(pixel + pixel.new_tensor(step)[:, None]) for step in _STEPS]
        (a, c), (b, d) = (ends[2 * axis][0].sub(ends[2 * axis + 1][0]).unbind(0) for axis in (0, 1))
        # the larger singular value of the Jacobian
        half, area = (a * a + b * b + c * c + d * d) / 2, a * d - b * c
        stretch = (half + (half * half - area * area).clamp(min=0).sqrt()).sqrt()
        share = (1 - 1 / stretch).clamp(min=0)  # the spline itself spans about a pixel
        inks = torch.stack([ink for _, ink in ends])
        return torch.where((inks != inks[0]).any(0), 1.0, share)
