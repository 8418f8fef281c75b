"""Inverses of the Laplacian of a pixel grid: exact on rectangles, multigrid on any mask.

The Laplacian of u at pixel p is the sum over its neighbours q of u_p - u_q. It is inverted for u
that is zero outside a mask. At the border of the image a pixel has fewer neighbours (Neumann), or
those of the other side (periodic).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.quadratic import dot

Inverse = Callable[[Tensor], Tensor]  # (1, h, w) -> (1, h, w), symmetric


def bounding_box(mask: Bool[Tensor, "h w"]) -> tuple[slice, slice]:
    """Rows and columns of the smallest rectangle around a mask, which must not be empty.

    Example:
        >>> bounding_box(torch.eye(4, dtype=torch.bool)[1:3])
        (slice(0, 2, None), slice(1, 3, None))
    """
    rows, cols = mask.any(1).nonzero(), mask.any(0).nonzero()
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


# Rectangles: the eigenvectors along an axis are sines where the image is held beyond both ends,
# cosines where both ends are free, waves where it is periodic. One held and one free end become
# two held ones when the axis is mirrored in the free one.


@dataclass(frozen=True)
class _Axis:
    kind: Literal["sine", "cosine", "wave"]
    length: int
    mirror: Literal["low", "high"] | None = None

    def spread(self, x: Tensor) -> Tensor:
        if self.mirror is None:
            return x
        return torch.cat([x.flip(-1), x] if self.mirror == "low" else [x, x.flip(-1)], -1)

    def crop(self, x: Tensor) -> Tensor:
        start = self.length if self.mirror == "low" else 0
        return x.narrow(-1, start, self.length)

    def eigenvalues(self, like: Tensor) -> Tensor:
        n = self.length * (1 if self.mirror is None else 2)
        k = torch.arange(n, dtype=torch.float64, device=like.device)
        angle = {"sine": (k + 1) / (n + 1), "cosine": k / n, "wave": 2 * k / n}[self.kind]
        return 4 * (angle * (math.pi / 2)).sin().square()

    def forward(self, x: Tensor) -> Tensor:
        n = x.shape[-1]
        if self.kind == "wave":  # Hartley's transform: real, and its own inverse but for n
            spectrum = torch.fft.fft(x)
            return spectrum.real - spectrum.imag
        if self.kind == "sine":
            return -torch.fft.rfft(F.pad(x, (1, 0)), n=2 * n + 2).imag[..., 1 : n + 1]
        spectrum = torch.fft.rfft(x, n=2 * n)[..., :n]
        cos, sin = self._turn(x)
        return spectrum.real * cos + spectrum.imag * sin

    def inverse(self, x: Tensor) -> Tensor:
        n = x.shape[-1]
        if self.kind == "wave":
            return self.forward(x) / n
        if self.kind == "sine":
            return self.forward(x) * (2 / (n + 1))
        cos, sin = self._turn(x)
        return 2 * torch.fft.irfft(torch.complex(x * cos, x * sin), n=2 * n)[..., :n]

    def _turn(self, x: Tensor) -> tuple[Tensor, Tensor]:
        n = x.shape[-1]
        angle = torch.arange(n, dtype=torch.float64, device=x.device) * (math.pi / 2 / n)
        return angle.cos().to(x), angle.sin().to(x)


def _axis(span: slice, size: int, periodic: bool) -> _Axis:
    length = span.stop - span.start
    if periodic:
        return _Axis("wave" if length == size else "sine", length)
    low, high = span.start == 0, span.stop == size
    if low and high:
        return _Axis("cosine", length)
    return _Axis("sine", length, "low" if low else "high" if high else None)


def direct(like: Float[Tensor, "..."], mask: Bool[Tensor, "h w"], periodic: bool) -> Inverse:
    """Inverse for a mask that is a filled rectangle, by sine, cosine or Fourier transforms.

    Of the whole image the pseudo-inverse: means are dropped.

    Args:
        like: sets dtype and device.

    Example:
        >>> mask = torch.zeros(3, 3, dtype=torch.bool)
        >>> mask[1, 1] = True
        >>> direct(torch.zeros(()), mask, False)(torch.ones(1, 3, 3))[0, 1].tolist()
        [0.0, 0.25, 0.0]
    """
    box = bounding_box(mask)
    y, x = (_axis(span, size, periodic) for span, size in zip(box, mask.shape, strict=True))
    values = x.eigenvalues(like)[:, None] + y.eigenvalues(like)
    divisor = torch.where(values > 0, 1 / values, 0).to(like)  # 0: the mean, which stays
    inside = (slice(None), *box)

    def system(b: Tensor) -> Tensor:
        rows = x.forward(x.spread(b[inside]))
        both = y.forward(y.spread(rows.mT.contiguous())) * divisor
        rows = y.crop(y.inverse(both)).mT.contiguous()
        out = torch.zeros_like(b)
        out[inside] = x.crop(x.inverse(rows))
        return out

    return system


# Masks of any shape: conjugate gradients, preconditioned by one multigrid cycle.


@dataclass(frozen=True)
class _Level:
    """A grid whose edges have weights. Pixels that no edge touches are not wanted.

    Args:
        right, down: (h, w), edges between wanted pixels; the last column of `right` and the last
            row of `down` lead back to the first, and are zero unless periodic.
        leak: weights of the edges that lead to given pixels, summed per pixel.
        diagonal: all weights, summed per pixel.
        scale: what a smoothing step multiplies the residual by.
    """

    right: Tensor
    down: Tensor
    leak: Tensor
    diagonal: Tensor
    scale: Tensor
    periodic: bool

    def apply(self, u: Tensor) -> Tensor:
        """A u."""
        return self._neighbours(self.diagonal * u, u, -1)

    def residual(self, u: Tensor, b: Tensor) -> Tensor:
        """b - A u."""
        return self._neighbours(torch.addcmul(b, self.diagonal, u, value=-1), u, 1)

    def _neighbours(self, out: Tensor, u: Tensor, sign: int) -> Tensor:
        for dim, weight in ((-1, self.right), (-2, self.down)):
            count = u.shape[dim] - 1
            for here, there in ((0, 1), (1, 0)):
                other = u.narrow(dim, there, count)
                edges = weight.narrow(dim, 0, count)
                out.narrow(dim, here, count).addcmul_(edges, other, value=sign)
                if self.periodic:
                    other = u.narrow(dim, count * here, 1)
                    edges = weight.narrow(dim, count, 1)
                    out.narrow(dim, count * there, 1).addcmul_(edges, other, value=sign)
        return out

    def smooth(self, u: Tensor, b: Tensor) -> None:
        """One damped Jacobi step, in place."""
        u.addcmul_(self.scale, self.residual(u, b))

    def coarser(self) -> "_Level":
        """Every 2 x 2 pixels become one.

        Halved sums of the weights of edges make the same equation on the coarse grid. Leaks are
        not halved, since given pixels come twice as near; but no more than four edges' worth.
        Source: overcorrected aggregation, Braess 1995; the rule for leaks was found by trial.
        """
        right = _pairs(_leaving(self.right, -1), -2) / 2
        down = _pairs(_leaving(self.down, -2), -1) / 2
        leak = _pairs(_pairs(self.leak, -1), -2)
        strongest = max(float(right.max()), float(down.max()))
        if strongest > 0:
            leak = leak.clamp(max=4 * strongest)
        return _level(right, down, leak, self.periodic)


def _level(right: Tensor, down: Tensor, leak: Tensor, periodic: bool) -> _Level:
    h, w = leak.shape  # on an axis of one pixel an edge would lead to itself, and hold nothing
    right, down = right * (w > 1), down * (h > 1)
    total = leak + right + right.roll(1, -1) + down + down.roll(1, -2)
    scale = torch.where(total > 0, 0.8 / total, 0)  # 0.8 damps Jacobi's steps
    return _Level(right, down, leak, total, scale, periodic)


def _finest(mask: Tensor, periodic: bool, dtype: torch.dtype) -> _Level:
    wanted = mask.to(dtype)
    right, down = wanted * wanted.roll(-1, -1), wanted * wanted.roll(-1, -2)
    if not periodic:
        right[:, -1], down[-1] = 0, 0
    mode = "circular" if periodic else "constant"
    given = F.pad((1 - wanted)[None, None], (1, 1, 1, 1), mode=mode)[0, 0]
    around = given[1:-1, 2:] + given[1:-1, :-2] + given[2:, 1:-1] + given[:-2, 1:-1]
    return _level(right, down, wanted * around, periodic)


def _pairs(x: Tensor, dim: int) -> Tensor:
    """Sums of two neighbours, the last alone when the length is odd."""
    if x.shape[dim] % 2:
        x = torch.cat([x, torch.zeros_like(x.narrow(dim, 0, 1))], dim)
    return x.unflatten(dim, (-1, 2)).sum(dim)


def _leaving(x: Tensor, dim: int) -> Tensor:
    """Edges that leave a pair of pixels: those of its second one, or of its only one."""
    size = x.shape[dim]
    last = torch.arange(1, size, 2, device=x.device)
    if size % 2:
        last = torch.cat([last, last.new_tensor([size - 1])])
    return x.index_select(dim, last)


def _cycle(levels: Sequence[_Level], b: Tensor) -> Tensor:
    """One V-cycle from zero, symmetric: two smoothing steps before and two after."""
    level, *coarser = levels
    u = level.scale * b  # the first smoothing step, from zero
    for _ in range(1 if coarser else 7):
        level.smooth(u, b)
    if not coarser:
        return u
    left = F.avg_pool2d(level.residual(u, b), 2, ceil_mode=True, divisor_override=1)
    step = F.interpolate(_cycle(coarser, left)[None], scale_factor=2)[0]
    u += step[..., : u.shape[-2], : u.shape[-1]]
    for _ in range(2):
        level.smooth(u, b)
    return u


def iterative(
    like: Float[Tensor, "..."],
    mask: Bool[Tensor, "h w"],
    periodic: bool,
    *,
    tolerance: float,
    steps: int,
) -> Inverse:
    """Inverse for any mask, by conjugate gradients to a relative residual.

    Of the whole image the pseudo-inverse: means are dropped.

    Args:
        like: sets dtype and device.
        tolerance: relative residual wanted.
        steps: most iterations; each is one multigrid cycle.

    Example:
        >>> mask = torch.ones(2, 3, dtype=torch.bool)
        >>> mask[1] = False
        >>> inverse = iterative(torch.zeros(()), mask, False, tolerance=1e-6, steps=20)
        >>> inverse(torch.ones(1, 2, 3))[0].round(decimals=4).tolist()
        [[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]
    """
    box = bounding_box(mask)
    grown = [slice(None) if periodic else slice(max(0, s.start - 1), s.stop + 1) for s in box]
    part = (slice(None), *grown)
    levels = [_finest(mask[None][part][0], periodic, like.dtype)]
    while max(levels[-1].leak.shape) > 2:
        levels.append(levels[-1].coarser())
    whole = bool(mask.all())  # then nothing holds the mean, and it stays

    def centred(x: Tensor) -> Tensor:
        return x - x.mean(-1).mean() if whole else x

    def system(b: Tensor) -> Tensor:
        inner = centred(torch.where(mask, b, 0)[part])
        out = torch.zeros_like(b)
        out[part] = centred(_conjugate(levels, inner, tolerance, steps))
        return torch.where(mask, out, 0)

    return system


def _conjugate(levels: Sequence[_Level], b: Tensor, tolerance: float, steps: int) -> Tensor:
    """Conjugate gradients; begun anew where rounding let the residual drift from the true one."""
    finest, x = levels[0], torch.zeros_like(b)
    enough = tolerance**2 * dot(b, b)
    for _ in range(3):
        residual = finest.residual(x, b)
        direction, gain = torch.zeros_like(b), b.new_ones(())
        while steps > 0 and bool(dot(residual, residual) > enough):
            steps -= 1
            z = _cycle(levels, residual)
            gain, before = dot(residual, z), gain
            direction = z.addcmul_(gain / before, direction)
            image = finest.apply(direction)
            curvature = dot(direction, image)
            if not bool(curvature > 0):  # what is left is rounding
                return x
            step = gain / curvature
            x.addcmul_(step, direction)
            residual.addcmul_(step, image, value=-1)
    return x
