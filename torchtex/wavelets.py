"""Orthogonal wavelets: of an image, decimated or stationary, and of windows.

All are linear and differentiable, in any dtype and on any device. Filters are sums of shifted
slices in a fixed order, gradients too, so that no bit depends on the number of threads.
"""

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

Taps = tuple[float, ...]
Boundary = Literal["reflect", "periodic"]


@lru_cache(maxsize=256)
def filters(wavelet: str) -> tuple[Taps, Taps]:
    """Low-pass and high-pass taps, in the order in which they multiply consecutive pixels.

    These are PyWavelets' decomposition filters, reversed: a sum over pixels instead of a
    convolution. Their squares sum to 1.

    Args:
        wavelet: any orthogonal wavelet of PyWavelets: haar, db1 to db38, sym2 to sym20, coif1
            to coif17.

    Raises:
        ValueError: the wavelet is unknown or not orthogonal.

    Source: Daubechies 1992, Ten Lectures on Wavelets, by way of PyWavelets.

    Example:
        >>> [round(tap, 4) for tap in filters("haar")[1]]
        [0.7071, -0.7071]
    """
    import pywt

    known = pywt.wavelist(kind="discrete")
    if wavelet not in known:
        near = difflib.get_close_matches(wavelet.lower(), known) or ["haar", "db2", "db4"]
        raise ValueError(f"wavelet={wavelet!r} is unknown; try {' or '.join(near)}")
    found = pywt.Wavelet(wavelet)
    low, high = tuple(found.dec_lo[::-1]), tuple(found.dec_hi[::-1])
    products = (
        sum(a * b for a, b in zip(low[s:], low, strict=False)) for s in range(0, len(low), 2)
    )
    exact = all(abs(p - (i == 0)) < 1e-9 for i, p in enumerate(products))
    if not (found.orthogonal and exact):  # "dmey" calls itself orthogonal, and is to 2e-3
        raise ValueError(f"wavelet={wavelet!r} is not orthogonal; choose haar, dbN, symN or coifN")
    return low, high


# ------------------------------------------------------------------------------- decimated


@dataclass(frozen=True)
class Coefficients:
    """The decimated transform of an image, as `decompose` gives it and `reconstruct` takes it.

    Args:
        approximation: the coarsest low-pass image.
        details: for each level, the coarsest first, (horizontal, vertical, diagonal). Horizontal
            edges show in the first: it is high-pass from row to row, low-pass along each row.
        size: (rows, columns) of the image.
        wavelet: its name.

    Example:
        >>> [tuple(band.shape) for band in decompose(torch.zeros(3, 9, 8), "haar", 2).details[0]]
        [(3, 3, 2), (3, 3, 2), (3, 3, 2)]
    """

    approximation: Float[Tensor, "c y x"]
    details: tuple[tuple[Tensor, Tensor, Tensor], ...]
    size: tuple[int, int]
    wavelet: str


def decompose(image: Float[Tensor, "c h w"], wavelet: str, levels: int) -> Coefficients:
    """The decimated, periodic transform of an image; an odd row or column is repeated first.

    Energy is kept where all sizes on the way are even: the squares of the coefficients sum to
    those of the pixels. Equals `pywt.wavedec2(..., mode="periodization")`.

    Args:
        levels: how often the approximation is halved; each level has half the rows and columns
            of the one before, rounded up.

    Raises:
        ValueError: an unknown or unsuitable `wavelet`, or more `levels` than halve the image.

    Source: Mallat 1989.

    Example:
        >>> decompose(torch.ones(3, 8, 8), "db2", 2).approximation.shape
        torch.Size([3, 2, 2])
    """
    low, high = filters(wavelet)
    h, w = image.shape[1:]
    most = math.ceil(math.log2(max(1, min(h, w))))
    if not 1 <= levels <= most:
        raise ValueError(f"levels={levels} must lie in 1..{most} for {h} x {w} pixels")
    details = []
    rest: Tensor = image
    for _ in range(levels):
        rest = _even(_even(rest, -2), -1)
        smooth, rough = _halve(rest, low, -1), _halve(rest, high, -1)
        details.append((_halve(smooth, high, -2), _halve(rough, low, -2), _halve(rough, high, -2)))
        rest = _halve(smooth, low, -2)
    return Coefficients(rest, tuple(details[::-1]), (h, w), wavelet)


def reconstruct(coefficients: Coefficients) -> Float[Tensor, "c h w"]:
    """The image that has these coefficients: the inverse of `decompose`, odd sizes included.

    For even sizes it is the adjoint as well.

    Source: Mallat 1989.

    Example:
        >>> image = torch.rand(3, 9, 7)
        >>> torch.allclose(reconstruct(decompose(image, "db2", 2)), image, atol=1e-5)
        True
    """
    low, high = filters(coefficients.wavelet)
    image: Tensor = coefficients.approximation
    sizes = [band[0].shape[1:] for band in coefficients.details[1:]] + [coefficients.size]
    for (horizontal, vertical, diagonal), (h, w) in zip(coefficients.details, sizes, strict=True):
        smooth = _double(image, low, -2) + _double(horizontal, high, -2)
        rough = _double(vertical, low, -2) + _double(diagonal, high, -2)
        image = (_double(smooth, low, -1) + _double(rough, high, -1))[:, :h, :w]
    return image


def every_shift(image: Float[Tensor, "c h w"], wavelet: str, levels: int) -> Coefficients:
    """The coefficients of `decompose` for all 4^levels shifts of an image at once.

    Every band is as large as the image. What `decompose` gives for a block of 2^levels pixels a
    side whose first pixel is (row, column) stands there: the approximation and the coarsest
    details at (row, column) itself, finer ones at steps of 2, 4, ... pixels from it; `blocks_at`
    reads them. Beyond its border the image is mirrored, so no filter meets the far side.

    Raises:
        ValueError: an unknown or unsuitable `wavelet`, or `levels` not in 1..8.

    Source: Holschneider et al. 1989; it is what Beylkin 1992 calls all circulant shifts.

    Example:
        >>> image = torch.rand(1, 8, 8)
        >>> bands = every_shift(image, "haar", 1)
        >>> whole = decompose(image, "haar", 1)
        >>> torch.allclose(bands.approximation[:, ::2, ::2], whole.approximation)
        True
    """
    low, high = filters(wavelet)
    if not 1 <= levels <= 8:
        raise ValueError(f"levels={levels} must lie in 1..8: at level 8 a block has 256 pixels")
    h, w = image.shape[1:]
    before, after = reach(wavelet, levels)
    rest = _extend(_extend(image, before, after, -2, "reflect"), before, after, -1, "reflect")
    details = []
    for level in range(levels):
        step = 2**level
        before -= (len(low) // 2 - 1) * step  # where the image begins in what is filtered
        smooth, rough = _filter(rest, low, step, -1), _filter(rest, high, step, -1)
        rest = _filter(smooth, low, step, -2)
        bands = (_filter(smooth, high, step, -2), _filter(rough, low, step, -2),
                 _filter(rough, high, step, -2))  # fmt: skip
        first, second, third = (b[:, before : before + h, before : before + w] for b in bands)
        details.append((first, second, third))
    return Coefficients(
        rest[:, before : before + h, before : before + w], tuple(details[::-1]), (h, w), wavelet
    )


def reach(wavelet: str, levels: int) -> tuple[int, int]:
    """Pixels that the coefficients of a block see before its first pixel, and after that one.

    Example:
        >>> reach("haar", 2), reach("db2", 1)
        ((0, 3), (1, 2))
    """
    half = len(filters(wavelet)[0]) // 2
    return (half - 1) * (2**levels - 1), half * (2**levels - 1)


def blocks_at(bands: Sequence[Coefficients], places: Int[Tensor, "h w 3"]) -> Coefficients:
    """Coefficients of an image put together from blocks of others, for `reconstruct`.

    Args:
        bands: of each exemplar, from `every_shift`, with the same wavelet and levels.
        places: exemplar, row and column of the first pixel of each block.

    Source: Pan et al. 2009, section 3.

    Example:
        >>> image = torch.rand(3, 12, 12)
        >>> places = torch.tensor([[[0, 1, 2], [0, 1, 4]]])
        >>> made = reconstruct(blocks_at([every_shift(image, "haar", 1)], places))
        >>> torch.allclose(made, image[:, 1:3, 2:6], atol=1e-6)
        True
    """
    which, rows, cols = places.unbind(-1)
    sizes = torch.tensor([one.size for one in bands], device=places.device)
    areas = sizes.prod(1)
    width = sizes[which, 1]
    first = (areas.cumsum(0) - areas)[which] + rows * width + cols
    levels = len(bands[0].details)

    def read(kind: list[Tensor], level: int) -> Tensor:
        """Values of a band of that level; each block has 4^(levels - level) of them."""
        flat = torch.cat([band.flatten(1) for band in kind], 1)
        inside = torch.arange(2 ** (levels - level), device=places.device) * 2**level
        down = inside[:, None, None] * width[:, None, :, None]
        at = first[:, None, :, None] + down + inside
        h, per, w, _ = at.shape
        return flat[:, at.reshape(h * per, w * per)]

    details = []
    for level in range(levels, 0, -1):
        groups = [one.details[levels - level] for one in bands]
        horizontal, vertical, diagonal = (
            read([group[kind] for group in groups], level) for kind in range(3)
        )
        details.append((horizontal, vertical, diagonal))
    approximation = read([one.approximation for one in bands], levels)
    h, w = places.shape[:2]
    return Coefficients(approximation, tuple(details), (h << levels, w << levels), bands[0].wavelet)


def _even(x: Tensor, dim: int) -> Tensor:
    if x.shape[dim] % 2 == 0:
        return x
    return torch.cat([x, x.narrow(dim, x.shape[dim] - 1, 1)], dim)


def _halve(x: Tensor, taps: Taps, dim: int) -> Tensor:
    """Filter and keep every second result: out[k] = sum over t of taps[t] x[2k + t + 1 - f/2]."""
    reach = len(taps) // 2 - 1
    wide = _extend(x, reach, reach, dim, "periodic").movedim(dim, -1)
    even = _filter(wide[..., 0::2], taps[0::2], 1, -1)
    odd = _filter(wide[..., 1::2], taps[1::2], 1, -1)
    return (even + odd).movedim(-1, dim)


def _double(x: Tensor, taps: Taps, dim: int) -> Tensor:
    """The adjoint of `_halve`: even and odd pixels are filtered with every second tap."""
    last = len(taps) // 2 - 1
    phases = []
    for phase in (0, 1):
        # out[2m + phase] = sum over u of taps[phase + last - 2u] x[m + u]
        first = -((len(taps) - phase - last - 1) // 2)
        steps = range(first, (phase + last) // 2 + 1)
        weights = tuple(taps[phase + last - 2 * u] for u in steps)
        phases.append(_filter(_extend(x, -first, steps[-1], dim, "periodic"), weights, 1, dim))
    return torch.stack([part.movedim(dim, -1) for part in phases], -1).flatten(-2).movedim(-1, dim)


# ------------------------------------------------------------------------------ stationary


def stationary(
    image: Float[Tensor, "c h w"],
    wavelet: str,
    levels: int,
    *,
    boundary: Boundary = "reflect",
) -> Float[Tensor, "bands c h w"]:
    """The undecimated ("a trous") transform: 1 + 3 `levels` bands, each as large as the image.

    Band 0 is the approximation. Then come horizontal, vertical and diagonal details (see
    `Coefficients`) of the coarsest level, and so on: bands 3i + 1 to 3i + 3 belong to level
    `levels` - i, and level 1 is the finest.

    The filters are divided by sqrt(2) on each axis and level. So with a periodic boundary the
    transform is a tight frame: the squares of all bands sum to those of the image, and it
    commutes with every circular shift.

    Each band is moved by whole pixels so that a coefficient sits at the centre of what it sees:
    the centroid of the squared taps of its whole cascade is at most half a pixel away.

    Args:
        boundary: how the image goes on outside, before the transform: mirrored at the centres of
            the border pixels, or periodic. Images smaller than the filters are continued as often
            as needed.

    Raises:
        ValueError: an unknown or unsuitable `wavelet`, a wrong `boundary`, or `levels` not in 1..8.

    Source: Holschneider et al. 1989; Nason and Silverman 1995, the stationary wavelet transform.

    Example:
        >>> bands = stationary(torch.ones(3, 8, 9), "db2", 2)
        >>> bands.shape, bands[0].mean().item(), bands[1:].abs().max().item() < 1e-6
        (torch.Size([7, 3, 8, 9]), 1.0, True)
    """
    if boundary not in ("reflect", "periodic"):
        raise ValueError(f'boundary={boundary!r} must be "reflect" or "periodic"')
    if not 1 <= levels <= 8:
        raise ValueError(f"levels={levels} must lie in 1..8: at level 8 a tap is 128 pixels wide")
    low, high, shifts, before, after = _cascade(wavelet, levels)
    h, w = image.shape[1:]
    rest = _extend(_extend(image, before, after, -2, boundary), before, after, -1, boundary)
    bands: list[Tensor] = []
    for level, (low_shift, high_shift) in enumerate(shifts):
        step = 2**level
        smooth, rough = _filter(rest, low, step, -1), _filter(rest, high, step, -1)
        rest = _filter(smooth, low, step, -2)
        # crop to the image on the finished axis before the other one is filtered
        smooth = smooth.narrow(-1, before - low_shift, w)
        rough = rough.narrow(-1, before - high_shift, w)
        bands = [
            _filter(smooth, high, step, -2).narrow(-2, before - high_shift, h),
            _filter(rough, low, step, -2).narrow(-2, before - low_shift, h),
            _filter(rough, high, step, -2).narrow(-2, before - high_shift, h),
            *bands,
        ]
    start = before - shifts[-1][0]
    return torch.stack([rest[:, start : start + h, start : start + w], *bands])


def band_names(levels: int) -> tuple[str, ...]:
    """What the bands of `stationary` and of `window_bands` are, in their order.

    Example:
        >>> band_names(2)[:4]
        ('approximation', 'horizontal 2', 'vertical 2', 'diagonal 2')
    """
    kinds = ("horizontal", "vertical", "diagonal")
    details = tuple(f"{kind} {level}" for level in range(levels, 0, -1) for kind in kinds)
    return ("approximation", *details)


@lru_cache(maxsize=256)
def _cascade(wavelet: str, levels: int) -> tuple[Taps, Taps, tuple[tuple[int, int], ...], int, int]:
    """Scaled taps; the pixel on which each level's filters centre; pixels needed on both sides."""
    low, high = (tuple(tap / math.sqrt(2) for tap in taps) for taps in filters(wavelet))
    whole = [1.0]  # taps of the approximation so far, as one filter
    shifts, reach = [], []
    for level in range(levels):
        centres = [_centre(_convolve(whole, taps, 2**level)) for taps in (low, high)]
        whole = _convolve(whole, low, 2**level)
        shifts.append((centres[0], centres[1]))
        reach.append(len(whole) - 1 - min(centres))
    return low, high, tuple(shifts), max(max(pair) for pair in shifts), max(reach)


def _convolve(a: list[float], taps: Taps, step: int) -> list[float]:
    out = [0.0] * (len(a) + (len(taps) - 1) * step)
    for j, tap in enumerate(taps):
        for i, value in enumerate(a):
            out[i + j * step] += tap * value
    return out


def _centre(taps: list[float]) -> int:
    energy = sum(tap * tap for tap in taps)
    centroid = sum(i * tap * tap for i, tap in enumerate(taps)) / energy
    return math.ceil(round(centroid, 6) - 0.5)


# --------------------------------------------------------------------------------- windows


def window_matrix(size: int, wavelet: str, levels: int) -> Float[Tensor, "size size"]:
    """The orthonormal matrix W of the periodic 1-D transform of `size` values. float64, CPU.

    Its rows list the approximation, then the details from the coarsest level to the finest. For
    one level, W X W^T is the 2-D transform of a window X. For more, W X W^T is the fully
    separable transform, which mixes levels (rows of one with columns of another); use
    `window_transform` for the usual one.

    Raises:
        ValueError: `size` cannot be halved `levels` times, or an unsuitable `wavelet`.

    Source: Mallat 1989.

    Example:
        >>> w = window_matrix(8, "db2", 2)
        >>> torch.allclose(w @ w.T, torch.eye(8, dtype=torch.float64))
        True
    """
    _check_window(size, levels)
    taps = filters(wavelet)
    matrix = torch.eye(size, dtype=torch.float64)
    for level in range(levels):
        part = size >> level
        rest = matrix[:part]
        halves = [_halve(rest, filter_, 0) for filter_ in taps]
        matrix = torch.cat([*halves, matrix[part:]])
    return matrix


def window_transform(
    patches: Float[Tensor, "n size size k"], wavelet: str, levels: int
) -> Float[Tensor, "n size size k"]:
    """The decimated, periodic 2-D transform of each window: orthonormal, so distances stay.

    A window of coefficients has the approximation in its top left corner; of what each level
    adds, horizontal details are below it, vertical ones to its right, diagonal ones opposite.
    `window_bands` tells which is which. Equals `pywt.wavedec2(..., mode="periodization")`.

    Args:
        patches: windows of `size` x `size` pixels with k channels.

    Raises:
        ValueError: as `window_matrix`.

    Source: Mallat 1989.

    Example:
        >>> patches = torch.ones(5, 8, 8, 3)
        >>> torch.allclose(window_transform(patches, "haar", 3)[:, 0, 0], torch.tensor(8.0))
        True
    """
    size = patches.shape[1]
    _check_window(size, levels)
    out = patches
    for level in range(levels):
        part = size >> level
        matrix = window_matrix(part, wavelet, 1).to(patches)
        block = torch.einsum("ir,nrck,jc->nijk", matrix, out[:, :part, :part], matrix)
        right = torch.cat([block, out[:, :part, part:]], 2)
        out = torch.cat([right, out[:, part:]], 1)
    return out


def window_bands(size: int, levels: int) -> Int[Tensor, "size size"]:
    """The band of each coefficient of `window_transform`, in the order of `band_names`.

    So `weights[window_bands(size, levels)]` weighs each coefficient by its band.

    Raises:
        ValueError: `size` cannot be halved `levels` times.

    Example:
        >>> window_bands(4, 2)
        tensor([[0, 2, 5, 5],
                [1, 3, 5, 5],
                [4, 4, 6, 6],
                [4, 4, 6, 6]])
    """
    _check_window(size, levels)
    bands = torch.zeros(size, size, dtype=torch.long)
    for level in range(1, levels + 1):
        half, whole = size >> level, size >> (level - 1)
        first = 3 * (levels - level) + 1
        bands[half:whole, :half] = first
        bands[:half, half:whole] = first + 1
        bands[half:whole, half:whole] = first + 2
    return bands


def _check_window(size: int, levels: int) -> None:
    if levels < 1:
        raise ValueError(f"levels={levels} must be at least 1")
    if size < 1 or size % 2**levels:
        raise ValueError(
            f"size={size} cannot be halved levels={levels} times; "
            f"choose a multiple of {2**levels} or fewer levels"
        )


# ------------------------------------------------------------------------------- one axis


def _extend(x: Tensor, before: int, after: int, dim: int, boundary: Boundary) -> Tensor:
    """`x` continued on both sides of one axis, as often as needed, from slices of it."""
    n = x.shape[dim]
    period = n if boundary == "periodic" else max(1, 2 * n - 2)
    pieces, place = [], -before
    while place < n + after:
        phase = place % period  # 0..n-1 runs forward, the rest of a mirrored period back
        run = min((n if phase < n else period) - phase, n + after - place)
        if phase < n:
            pieces.append(x.narrow(dim, phase, run))
        else:
            pieces.append(x.narrow(dim, period - phase - run + 1, run).flip(dim))
        place += run
    return pieces[0] if len(pieces) == 1 else torch.cat(pieces, dim)


def _filter(x: Tensor, taps: Taps, step: int, dim: int) -> Tensor:
    """out[i] = sum over t of taps[t] x[i + t step] along one axis, where that fits in."""
    out: Tensor = _Filter.apply(x, taps, step, dim)  # type: ignore[no-untyped-call]
    return out


def _spread(x: Tensor, taps: Taps, step: int, dim: int) -> Tensor:
    """The adjoint of `_filter`: each value goes back to the places that it came from."""
    out: Tensor = _Spread.apply(x, taps, step, dim)  # type: ignore[no-untyped-call]
    return out


class _Filter(torch.autograd.Function):
    # adding slices in place is several times faster on a CPU than convolution with dilated taps
    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, taps: Taps, step: int, dim: int) -> Tensor:
        count = x.shape[dim] - step * (len(taps) - 1)
        out = x.narrow(dim, 0, count) * taps[0]
        for t, tap in enumerate(taps[1:], 1):
            out.add_(x.narrow(dim, t * step, count), alpha=tap)
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.settings = inputs[1:]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        return _spread(gradients[0], *ctx.settings), None, None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return _filter(tangents[0], *ctx.settings)


class _Spread(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, taps: Taps, step: int, dim: int) -> Tensor:
        shape, count = list(x.shape), x.shape[dim]
        shape[dim] += step * (len(taps) - 1)
        out = x.new_zeros(shape)
        for t, tap in enumerate(taps):
            out.narrow(dim, t * step, count).add_(x, alpha=tap)
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.settings = inputs[1:]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        return _filter(gradients[0], *ctx.settings), None, None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return _spread(tangents[0], *ctx.settings)
