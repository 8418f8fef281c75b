"""Images from their gradients: the Poisson equation on rectangles and on masks of any shape.

Guidance is a field on the edges between neighbouring pixels. The image that follows it minimises

    sum over edges (p, q) of |f_p - f_q - v_pq|^2,  f given outside the mask.

A rectangle is solved exactly by sine, cosine or Fourier transforms, any other mask by conjugate
gradients with a multigrid cycle before them.

Source: Perez et al. 2003, Poisson image editing; Agarwala et al. 2004 for composites.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.cuts.laplace import Inverse, bounding_box, direct, iterative
from torchtex.image import check_image

Boundary = Literal["dirichlet", "free"]
Method = Literal["auto", "direct", "iterative"]


@dataclass(frozen=True)
class Guidance:
    """Wanted differences between neighbours: right minus left, and lower minus upper.

    Args:
        right: (c, h, w - 1); periodic: (c, h, w), the last column leads back to the first.
        down: (c, h - 1, w); periodic: (c, h, w), the last row leads back to the first.
        periodic: the image has no border: it continues on its other side.

    Raises:
        ValueError: the two fields belong to images of different sizes.

    Example:
        >>> Guidance(torch.zeros(3, 4, 4), torch.zeros(3, 3, 5)).shape
        (3, 4, 5)
    """

    right: Float[Tensor, "c _ _"]
    down: Float[Tensor, "c _ _"]
    periodic: bool = False

    def __post_init__(self) -> None:
        cut = 0 if self.periodic else 1
        c, h, w = self.shape
        if self.right.shape != (c, h, w - cut) or self.down.shape != (c, h - cut, w):
            raise ValueError(
                f"right has shape {tuple(self.right.shape)} and down {tuple(self.down.shape)}, "
                "which fit no image; take both from one image with gradients(...)"
            )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, rows and columns of the image that it guides."""
        c, h, _ = self.right.shape
        return c, h, self.down.shape[2]


def gradients(image: Float[Tensor, "c h w"], *, periodic: bool = False) -> Guidance:
    """The image's own differences: guidance that gives the image back.

    Example:
        >>> gradients(torch.tensor([[[0.0, 1.0, 3.0]]])).right.tolist()
        [[[1.0, 2.0]]]
    """
    left, right = _ends(image, -1, periodic)
    upper, lower = _ends(image, -2, periodic)
    return Guidance(right - left, lower - upper, periodic)


def mixed(
    base: Float[Tensor, "c h w"], source: Float[Tensor, "c h w"], *, periodic: bool = False
) -> Guidance:
    """On every edge the stronger difference of the two images, all channels of it; ties: base.

    Strength is measured over the channels together, so that no colour is mixed from both.

    Raises:
        ValueError: the images differ in shape.

    Source: Perez et al. 2003, mixed gradients (there channel by channel).

    Example:
        >>> base, source = torch.tensor([[[0.0, 1.0, 1.5]]]), torch.tensor([[[0.0, 0.5, 2.5]]])
        >>> mixed(base, source).right.tolist()
        [[[1.0, 2.0]]]
    """
    if base.shape != source.shape:
        raise ValueError(
            f"source has shape {tuple(source.shape)} and base {tuple(base.shape)}; "
            "bring them to one size"
        )
    ours, theirs = gradients(base, periodic=periodic), gradients(source, periodic=periodic)

    def stronger(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(b.square().sum(0) > a.square().sum(0), b, a)

    return Guidance(stronger(ours.right, theirs.right), stronger(ours.down, theirs.down), periodic)


def from_labels(
    sources: Sequence[Float[Tensor, "c h w"]],
    labels: Int[Tensor, "h w"],
    *,
    periodic: bool = False,
) -> Guidance:
    """Guidance of a montage in which pixel p comes from `sources[labels[p]]`, in place.

    Inside a region it is the gradient of the region's source; on an edge across a seam the mean
    of the two sources' gradients there.

    Raises:
        ValueError: no sources, sources of different shapes, or a label that names none.

    Source: Agarwala et al. 2004, gradient-domain fusion.

    Example:
        >>> dark, light = torch.zeros(1, 1, 4), torch.tensor([[[5.0, 6.0, 7.0, 8.0]]])
        >>> from_labels([dark, light], torch.tensor([[0, 0, 1, 1]])).right.tolist()
        [[[0.0, 0.5, 1.0]]]
    """
    if not sources:
        raise ValueError("sources is empty; give at least one image")
    for source in sources:
        check_image(source, "source")
        if source.shape != sources[0].shape or source.shape[1:] != labels.shape:
            raise ValueError(
                f"sources have shapes {[tuple(s.shape) for s in sources]} and labels "
                f"{tuple(labels.shape)}; place them all in one frame"
            )
    if int(labels.min()) < 0 or int(labels.max()) >= len(sources):
        raise ValueError(
            f"labels run from {int(labels.min())} to {int(labels.max())}; "
            f"with {len(sources)} sources they must lie in 0..{len(sources) - 1}"
        )
    right = down = torch.zeros(())
    for label, source in enumerate(sources):
        field, here = gradients(source, periodic=periodic), (labels == label).to(source)
        right = right + sum(_ends(here, -1, periodic)) / 2 * field.right
        down = down + sum(_ends(here, -2, periodic)) / 2 * field.down
    return Guidance(right, down, periodic)


def solve(
    guidance: Guidance,
    base: Float[Tensor, "c h w"],
    mask: Bool[Tensor, "h w"] | None = None,
    *,
    boundary: Boundary = "dirichlet",
    method: Method = "auto",
    tolerance: float = 1e-5,
    steps: int = 100,
) -> Float[Tensor, "c h w"]:
    """The image that follows the guidance inside the mask and equals `base` outside it.

    Differentiable in the guidance and in `base`, twice and more: the gradient is one more solve
    of the same symmetric system. Where nothing is given, that is when the mask is the whole image,
    each channel keeps the mean of `base`. Inside the mask `base` is only where the solver starts.
    An empty mask gives `base` back.

    Args:
        mask: True where the image is wanted; None for everywhere.
        boundary: at the image's own border, "dirichlet" allows no mask there, since no value
            beyond it is given, and "free" lets the image end as it likes (Neumann). A periodic
            guidance leaves no border, and so no choice.
        method: "direct" for masks that are filled rectangles, "iterative" for any, or "auto".
        tolerance: relative residual at which "iterative" stops; float32 cannot go much below 1e-6.
        steps: most iterations; about ten are used.

    Raises:
        ValueError: sizes or dtypes that differ, NaN, a mask that touches the border without
            boundary="free", or method="direct" for a mask that is no rectangle.

    Example:
        >>> image = torch.rand(3, 8, 9)
        >>> found = solve(gradients(image), torch.zeros(3, 8, 9) + image.mean((1, 2), True),
        ...               boundary="free")
        >>> torch.allclose(found, image, atol=1e-5)
        True
    """
    if mask is None:
        mask = torch.ones(base.shape[1:], dtype=torch.bool, device=base.device)
    _check(guidance, base, mask, boundary, method)
    if not tolerance > 0 or steps < 1:
        raise ValueError(f"tolerance={tolerance} must be above 0 and steps={steps} at least 1")
    if not mask.any():
        return base.clone()
    periodic = guidance.periodic
    rectangle = bool(mask[bounding_box(mask)].all())
    if method == "direct" and not rectangle:
        raise ValueError('method="direct" needs a mask that is a filled rectangle; use "auto"')
    if rectangle and method != "iterative":
        inverse = direct(base, mask, periodic)
    else:
        inverse = iterative(base, mask, periodic, tolerance=tolerance, steps=steps)
    # solved for the change of base: zero outside the mask, and small numbers keep their digits
    excess = _pull(guidance) - _pull(gradients(base, periodic=periodic))
    change = _Solve.apply(torch.where(mask, excess, 0), inverse)
    return torch.where(mask, base + change, base)


def _check(
    guidance: Guidance, base: Tensor, mask: Tensor, boundary: Boundary, method: Method
) -> None:
    check_image(base, "base")
    for name, value, known in (("boundary", boundary, Boundary), ("method", method, Method)):
        if value not in get_args(known):
            raise ValueError(f"{name}={value!r} must be one of {', '.join(get_args(known))}")
    if guidance.shape != base.shape or mask.shape != base.shape[1:]:
        raise ValueError(
            f"base has shape {tuple(base.shape)}, guidance is for {guidance.shape} and mask has "
            f"shape {tuple(mask.shape)}; bring them to one size"
        )
    if base.dtype not in (torch.float32, torch.float64) or guidance.right.dtype != base.dtype:
        raise ValueError(
            f"base is {base.dtype} and guidance {guidance.right.dtype}; "
            "convert both to float32 or both to float64"
        )
    if not (guidance.right.isfinite().all() and guidance.down.isfinite().all()):
        raise ValueError("guidance holds NaN or infinity; replace them")
    if boundary == "dirichlet" and not guidance.periodic:
        border = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
        if border.any():
            raise ValueError(
                "mask touches the image border, beyond which no value is given; "
                'use boundary="free" or keep one pixel away from it'
            )


def _ends(x: Tensor, dim: int, periodic: bool) -> tuple[Tensor, Tensor]:
    """Values at the two ends of every edge along an axis."""
    if periodic:
        return x, x.roll(-1, dim)
    count = x.shape[dim] - 1
    return x.narrow(dim, 0, count), x.narrow(dim, 1, count)


def _pull(guidance: Guidance) -> Tensor:
    """Sum over the edges of p of v_pq: the right side of the normal equations."""
    right, down = guidance.right, guidance.down
    if guidance.periodic:
        return right.roll(1, -1) - right + down.roll(1, -2) - down
    across = F.pad(right, (1, 0)) - F.pad(right, (0, 1))
    return across + F.pad(down, (0, 0, 1, 0)) - F.pad(down, (0, 0, 0, 1))


class _Solve(torch.autograd.Function):
    """A symmetric inverse, channel by channel, which bounds the memory; its own adjoint."""

    @staticmethod
    def forward(ctx: Any, b: Tensor, inverse: Inverse) -> Tensor:
        ctx.inverse = inverse
        return torch.cat([inverse(channel) for channel in b.split(1)])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return _Solve.apply(grads[0], ctx.inverse), None
