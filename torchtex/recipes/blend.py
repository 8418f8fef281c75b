"""Clone a piece of one image into another without a visible border."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.cuts.poisson import Boundary, gradients, solve
from torchtex.cuts.poisson import mixed as mixed_gradients
from torchtex.inputs import check_pair
from torchtex.recipes.montage import Montage
from torchtex.sources import copied, pixel_places


@dataclass(frozen=True)
class Blend:
    """A piece of `source` cloned into `base`.

    Args:
        image: the result; it may leave [0, 1] a little, and `torchtex.image.save` clips it.
        pasted: the baseline: the piece copied as it is.
        mask: the piece in the frame of `base`.
        lost: pixels of the mask that fell outside `base`.

    Example:
        >>> done = blend(torch.rand(1, 9, 9), torch.rand(1, 2, 2), torch.ones(2, 2).bool(), (8, 3))
        >>> int(done.mask.sum()), done.lost
        (2, 2)
    """

    image: Float[Tensor, "c h w"]
    pasted: Float[Tensor, "c h w"]
    mask: Bool[Tensor, "h w"]
    lost: int


def paste(
    base: Float[Tensor, "c h w"],
    source: Float[Tensor, "c hs ws"],
    mask: Bool[Tensor, "hs ws"],
    offset: tuple[int, int] = (0, 0),
) -> Float[Tensor, "c h w"]:
    """The pixels of `source` under the mask copied into `base`: the baseline of `blend`.

    Args and Raises: as `blend`.

    Example:
        >>> paste(torch.zeros(1, 1, 3), torch.ones(1, 1, 1), torch.ones(1, 1).bool(), (0, 1))
        tensor([[[0., 1., 0.]]])
    """
    canvas, placed = _placed(base, source, mask, offset)
    return torch.where(placed, canvas, base)


def blend(
    base: Float[Tensor, "c h w"],
    source: Float[Tensor, "c hs ws"],
    mask: Bool[Tensor, "hs ws"],
    offset: tuple[int, int] = (0, 0),
    *,
    mixed: bool = False,
    boundary: Boundary = "free",
    tolerance: float = 1e-5,
) -> Blend:
    """Clone the masked piece of `source` into `base`: its gradients, with base's colours around.

    What falls outside `base` is cut off. Across the edge of `source` itself, where it has no
    gradient, the result is asked to be flat. Differentiable in both images.

    Args:
        source: may be smaller or larger than `base`.
        mask: in the frame of `source`, True where it is cloned.
        offset: row and column in `base` of the first pixel of `source`; may be negative.
        mixed: keep the stronger gradient of the two images, for holes and transparent things.
        boundary: where the piece touches the border of `base`: "free" lets it end there as it
            likes, "dirichlet" refuses it. A piece that covers all of `base` keeps base's mean.
        tolerance: relative residual of the solver.

    Raises:
        ValueError: an image that is none or holds NaN, images of different channels or dtypes, a
            mask of another size than `source` or without a True pixel, a piece that lies outside
            `base` or, with boundary="dirichlet", at its border.

    Source: Perez et al. 2003, seamless cloning.

    Example:
        >>> base, source = torch.full((3, 16, 16), 0.2), torch.full((3, 6, 6), 0.9)
        >>> done = blend(base, source, torch.ones(6, 6, dtype=torch.bool), (5, 5))
        >>> torch.allclose(done.image, base), torch.allclose(done.pasted, base)
        (True, False)
    """
    canvas, placed = _placed(base, source, mask, offset)
    guidance = mixed_gradients(base, canvas) if mixed else gradients(canvas)
    image = solve(guidance, base, placed, boundary=boundary, tolerance=tolerance)
    lost = int(mask.sum()) - int(placed.sum())
    return Blend(image, torch.where(placed, canvas, base), placed, lost)


def blended_montage(
    done: Blend,
    size: tuple[int, int],
    offset: tuple[int, int],
    *,
    poisson: bool = True,
    seconds: float = 0.0,
) -> Montage:
    """A blend with the source of every pixel: exemplar 0 is the base, 1 the source.

    Args:
        size: height and width of the source.
        offset: as given to `blend`.
        poisson: the blended pixels; otherwise the pasted ones.
        seconds: that it took.

    Example:
        >>> base, source = torch.rand(1, 9, 9), torch.rand(1, 2, 2)
        >>> done = blend(base, source, torch.ones(2, 2).bool(), (4, 3))
        >>> whole = blended_montage(done, (2, 2), (4, 3), poisson=False)
        >>> torch.equal(whole.apply([base, source]), whole.texture)
        True
    """
    piece = done.mask.long()
    places = pixel_places(done.mask.shape, piece.device)
    places = places - piece[..., None] * places.new_tensor(offset)
    shapes = ((done.mask.shape[0], done.mask.shape[1]), size)
    field = copied(torch.cat([piece[..., None], places], -1), shapes)
    texture = (done.image if poisson else done.pasted).clamp(0, 1)
    settings = {"recipe": "blend", "lost": done.lost, "poisson": poisson}
    return Montage(texture, field, piece, seconds, 0, settings)


def _placed(
    base: Tensor, source: Tensor, mask: Tensor, offset: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Base with the source laid over it, one pixel wider by its edge's colours; mask in base."""
    _check(base, source, mask)
    wide, piece = F.pad(source, (1, 1, 1, 1), mode="replicate"), F.pad(mask, (1, 1, 1, 1))
    (above, to_rows), (before, to_cols) = (
        _overlap(start - 1, length, room)
        for start, length, room in zip(offset, piece.shape, base.shape[1:], strict=True)
    )
    canvas, placed = base.clone(), torch.zeros_like(base[0], dtype=torch.bool)
    canvas[:, to_rows, to_cols] = wide[:, above, before]
    placed[to_rows, to_cols] = piece[above, before]
    if not placed.any():
        raise ValueError(
            f"offset={tuple(offset)} puts the whole mask outside base of {base.shape[1]} x "
            f"{base.shape[2]} pixels; choose an offset that leaves some of it inside"
        )
    return canvas, placed


def _overlap(start: int, length: int, room: int) -> tuple[slice, slice]:
    """Of `length` pixels placed at `start`, those within `room`: in their frame and in the room."""
    first, last = min(max(start, 0), room), min(max(start + length, 0), room)
    return slice(first - start, max(first, last) - start), slice(first, max(first, last))


def _check(base: Tensor, source: Tensor, mask: Tensor) -> None:
    check_pair(base, source, "source")
    if mask.shape != source.shape[1:]:
        raise ValueError(
            f"mask has shape {tuple(mask.shape)} and source {tuple(source.shape[1:])}; "
            "a mask has the size of its source (rows, columns)"
        )
    if not mask.any():
        raise ValueError("mask is empty: no pixel is True; mark what shall be cloned")
