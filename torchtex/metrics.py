"""Quality measures: how a texture compares with its exemplar, without network weights.

Each number can be fooled alone, so read `battery` as a whole and beside two anchors measured the
same way: another part of the exemplar's photo, and the exemplar tiled. See docs/metrics.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from kornia.color import rgb_to_grayscale
from kornia.filters import gaussian_blur2d
from torch import Tensor

from torchtex.matching import two_sided_minima

_KEPT = 0.999  # share of the patches' variance that the fast search looks at
_OVERLAP = 0.25  # share of an image that must overlap its shifted self
_ORIENTATIONS = 6


def nn(
    texture: Float[Tensor, "c h w"],
    exemplar: Float[Tensor, "c hz wz"],
    *,
    patch: int = 7,
    exact: bool = False,
) -> float:
    """How far the texture's patches are from the exemplar's.

    mean over s in P(X) of min over e in P(Z) of |s - e|^2 / U, where P are all patch x patch
    windows and U = mean over e of |e - mean e|^2. Unit: 1 is the error of always answering with
    the mean patch. At most the level of another part of the exemplar's photo is good; lower is
    not better.

    Fooled alone by copying the exemplar, by blur and by flat colour: see `copy`, `miss`, `spec`.
    It is also the loss that texture optimisation lowers, so methods must not be ranked by it.

    Args:
        patch: side of the windows in pixels.
        exact: search all dimensions. Otherwise nearest patches are sought in the principal axes
            that hold 99.9% of the exemplar's variance, plus the norm of the rest, and the
            distance to the patch found is then exact: too high by at most .0004 on six photos
            against copies, blends and blurs of them, by .01 (of 1) on shuffled pixels.

    Source: the texture energy of Kwatra et al. 2005, for r = 2.

    Example:
        >>> exemplar = torch.rand(3, 12, 12)
        >>> nn(exemplar[:, 2:], exemplar) < 1e-4
        True
    """
    return _match(texture, exemplar, patch, exact).nn


def tail(
    texture: Float[Tensor, "c h w"],
    exemplar: Float[Tensor, "c hz wz"],
    *,
    patch: int = 5,
    quantile: float = 0.99,
    exact: bool = False,
) -> float:
    """How bad the worst patches are: a high quantile of what `nn` averages, in the same unit.

    Broken structure and hard seams are rare, and vanish in a mean. At most the level of another
    part of the photo is good. Fooled alone by blur and flat colour (see `miss`, `spec`) and by
    copying (see `copy`); on a stochastic texture it hardly tells blocks from the photo.

    Args:
        patch: side of the windows in pixels.
        quantile: 0.99 for the worst hundredth.
        exact: search for all patches. Otherwise for every third of a texture with more than
            20000, on diagonals that meet all rows and columns alike; the distances themselves
            are exact. The quantile strays by .8% on average, rarely by more than 2%.

    Example:
        >>> exemplar = torch.rand(3, 12, 12)
        >>> tail(exemplar[:, 2:], exemplar) < 1e-4
        True
    """
    if not 0 <= quantile <= 1:
        raise ValueError(f"quantile={quantile} must lie in 0..1, such as 0.99")
    texture, exemplar = _pair(texture, exemplar, patch)
    queries, keys, unit = _patches(texture, exemplar, patch)
    if not exact and len(queries) > 20000:
        site = torch.arange(len(queries), device=texture.device)
        width = texture.shape[2] - patch + 1
        queries = queries[(site // width + site % width) % 3 == 0]
    labels = two_sided_minima(queries, keys, chunk=_chunk(queries))[1]
    distance = _squared(queries, keys, labels).sort().values
    return float(distance[round(quantile * (len(distance) - 1))] / unit)


def miss(
    texture: Float[Tensor, "c h w"],
    exemplar: Float[Tensor, "c hz wz"],
    *,
    patch: int = 7,
    exact: bool = False,
) -> float:
    """How much of the exemplar the texture lost.

    mean over e in P(Z) of min over s in P(X) of |e - s|^2 / U, in the unit of `nn`. Lower is
    better: 0 when every exemplar patch occurs, 1 for flat colour. Methods that invent content
    score no better than another part of the photo.

    Fooled alone by keeping the exemplar inside the texture (see `copy`, `repeat`): score only
    what lies outside it.

    Args:
        patch: side of the windows in pixels.
        exact: search all dimensions. Otherwise the distance in the axes of `nn` is reported, a
            lower bound: too low by .001 on average and at most .0033 on the same photos, by .03
            (of 1) on shuffled pixels.

    Source: the completeness term of Simakov et al. 2008.

    Example:
        >>> exemplar = torch.rand(3, 12, 12)
        >>> miss(exemplar.repeat(1, 2, 2), exemplar) < 1e-4
        True
    """
    return _match(texture, exemplar, patch, exact).miss


def swd(
    texture: Float[Tensor, "c h w"],
    exemplar: Float[Tensor, "c hz wz"],
    *,
    patch: int = 7,
    scales: int = 3,
    directions: int = 128,
    quantiles: int = 512,
    seed: int = 0,
) -> float:
    """Sliced Wasserstein distance of the two sets of patches.

    mean over scales and fixed random unit directions w of W1(w.P(Z), w.P(X)) / std(w.P(Z)), with
    W1 the mean difference of the quantiles. Each scale halves the images by averaging 2 x 2
    pixels; scales too small for a patch are left out. Unit: standard deviations of the exemplar;
    .8 for flat colour. At most the level of another part of the photo is good.

    Fooled alone by noise with the exemplar's spectrum (see `nn`, `miss`) and by hard-edged blocks
    of it (see `tail`).

    Args:
        patch: side of the windows in pixels.
        scales, directions, quantiles: number of each.
        seed: of the directions; keep it, or numbers cannot be compared.

    Source: Rabin et al. 2011; on patches, Karras et al. 2018 and Elnekave and Weiss 2022.

    Example:
        >>> exemplar = torch.rand(3, 12, 12)
        >>> swd(exemplar, exemplar)
        0.0
    """
    for name, value in (("scales", scales), ("directions", directions), ("quantiles", quantiles)):
        if value < 1:
            raise ValueError(f"{name}={value} must be at least 1")
    texture, exemplar = _pair(texture, exemplar, patch)
    generator = torch.Generator().manual_seed(seed)
    shape = (directions, exemplar.shape[0], patch, patch)
    weight = torch.randn(shape, generator=generator, dtype=torch.float64)
    weight = F.normalize(weight.flatten(1), dim=1).view(shape).to(exemplar)
    found: list[Tensor] = []
    least = exemplar.new_zeros(directions)  # a coarse scale of a fine pattern may be flat
    for _ in range(scales):
        theirs, ours = (F.conv2d(x[None], weight)[0].flatten(1) for x in (exemplar, texture))
        spread = torch.maximum(theirs.std(1), least)
        least = torch.maximum(least, 0.01 * spread)
        gap = (_quantiles(theirs, quantiles) - _quantiles(ours, quantiles)).abs().mean(1)
        found.append((gap / spread).mean())
        if min(*texture.shape[1:], *exemplar.shape[1:]) < 2 * (patch + 1):
            break
        texture, exemplar = (F.avg_pool2d(x[None], 2)[0] for x in (texture, exemplar))
    return float(torch.stack(found).mean())


def spec(
    texture: Float[Tensor, "c h w"], exemplar: Float[Tensor, "c hz wz"], *, window: int = 64
) -> float:
    """Difference of the power spectra, in powers of ten.

    mean over 6 orientations x octaves of |log10(S_X / S_Z)|, where S is the power in that cell,
    averaged over half-overlapping Hann windows and over channels, of the image less its mean.
    0.3 is a factor of two. At most the level of another part of the photo is good; blur gives
    about 1, flat colour more than 10.

    Fooled alone by noise with the exemplar's spectrum: see `nn` and `miss`.

    Args:
        window: side of the windows in pixels, a power of two; the octaves are one fewer than
            its logarithm (5 for 64). Images with a shorter side get the largest power of two
            that fits, and numbers for different windows do not compare.

    Source: Welch 1967.

    Example:
        >>> exemplar = torch.rand(1, 32, 32)
        >>> round(spec(exemplar / 2, exemplar), 3)
        0.602
    """
    if window < 8 or window & (window - 1):
        raise ValueError(f"window={window} must be a power of two of at least 8, such as 64")
    texture, exemplar = _pair(texture, exemplar, 7)
    while window > min(*texture.shape[1:], *exemplar.shape[1:]):
        window //= 2
    cells = _cells(window).to(exemplar)
    ours, theirs = (cells @ _spectrum(x, window).flatten() for x in (texture, exemplar))
    floor = 1e-12 * theirs.mean()
    return float(((ours + floor) / (theirs + floor)).log10().abs().mean())


def copy(
    texture: Float[Tensor, "c h w"],
    exemplar: Float[Tensor, "c hz wz"],
    *,
    patch: int = 7,
    exact: bool = False,
) -> float:
    """How large the verbatim pieces of the exemplar are.

    mean over patches s of min(1, |R(s)| / |P(Z)|), where R(s) is the 4-connected region of
    patches whose nearest exemplar patches have the same offset. 0 is fresh, near 1 is the
    exemplar itself, tiled.

    Fooled alone by noise (see `nn`), and by any change that moves nearest patches about: blur
    hides a tiling from it, but not from `repeat`. Where the exemplar repeats itself exactly, the
    nearest patch is a tie and regions fall apart.

    Args:
        patch: side of the windows in pixels.
        exact: as for `nn`; the fast search gives at most .001 less.

    Source: "verbatim copying" of Efros and Leung 1999, made a number.

    Example:
        >>> exemplar = torch.rand(3, 12, 12)
        >>> copy(exemplar, exemplar)
        1.0
    """
    return _match(texture, exemplar, patch, exact).copy


def repeat(texture: Float[Tensor, "c h w"], exemplar: Float[Tensor, "c hz wz"]) -> float:
    """How much more the texture repeats itself than the exemplar does.

    max over far lags of autocorrelation(X) - max(0, same of Z), of the high-passed luminance
    (pixels less a Gaussian blur with sigma = 1/16 of the exemplar's shorter side). Far is at
    least a quarter of that side in rows or in columns, with a quarter of the image still
    overlapping. About 1 less the exemplar's own value for a tiling, 0 or less for a photo.

    Fooled alone by noise: see `nn`. A periodic exemplar repeats itself, and then no more can be
    told from this number.

    Example:
        >>> exemplar = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))
        >>> repeat(exemplar.repeat(1, 2, 2), exemplar) > 0.5
        True
    """
    texture, exemplar = _pair(texture, exemplar, 7)
    side = min(exemplar.shape[1:])
    if max(texture.shape[1:]) * (1 - _OVERLAP) < side / 4:
        raise ValueError(
            f"texture of {_size(texture)} px has no shift of {side / 4:g} px (a quarter of the "
            "exemplar) that leaves a quarter of it overlapping; give a larger texture"
        )
    theirs = _far_autocorrelation(exemplar, side)
    return _far_autocorrelation(texture, side) - max(0.0, theirs)


def seam(texture: Float[Tensor, "c h w"], *, segment: int | None = None) -> float:
    """How visible the borders are when the texture is tiled.

    max over both axes of mean|X_0 - X_-1| / mean over i of mean|X_i - X_i+1|: 1 tiles, clearly
    above 1 does not.

    Fooled alone by a blurred border, and by a short bad stretch that the mean hides. Against the
    first, score `tail` and `spec` of the 32-px strip around the border of the rolled texture;
    against the second, give `segment`.

    Args:
        segment: compare the worst stretch of so many pixels along the border with the worst
            stretch between each pair of neighbouring lines inside, so that 1 still tiles;
            16 in `battery`.

    Example:
        >>> round(seam(torch.arange(8.0).expand(3, 8, 8) / 8), 3)
        7.0
    """
    texture = _image("texture", texture, 3)
    length = min(texture.shape[1:])
    if segment is not None and not 1 <= segment <= length:
        raise ValueError(f"segment={segment} must lie in 1..{length}, the texture's shorter side")
    worst = 0.0
    for lines in (texture.transpose(0, 1), texture.permute(2, 0, 1)):  # (line, c, along) each
        step = (lines - lines.roll(-1, 0)).abs().mean(1)
        if segment is None:
            step = step.mean(1)
        else:
            step = step.unfold(1, segment, 1).mean(2).amax(1)
        tiny = 1e-8  # flat colour tiles
        worst = max(worst, float((step[-1] + tiny) / (step[:-1].mean() + tiny)))
    return worst


def diversity(
    textures: Sequence[Float[Tensor, "c h w"]],
    exemplar: Float[Tensor, "c hz wz"],
    *,
    seed: int = 0,
) -> float:
    """How different the textures of one method are from one another: a test of the method.

    mean over pairs of mean|X_a - X_b| / mean|Z - Z with its pixels shuffled|. Free synthesis
    should give more than 0.5; 0 means that the seed changes nothing.

    Fooled alone by noise, which is diverse: see `nn`. Shifted copies of one texture are diverse
    too.

    Args:
        textures: at least two of the same size, from different seeds.
        seed: of the shuffle.

    Example:
        >>> exemplar = torch.rand(3, 12, 12)
        >>> diversity([exemplar, exemplar], exemplar)
        0.0
    """
    if len(textures) < 2:
        raise ValueError(f"textures holds {len(textures)} image; give two or more seeds' results")
    pairs = [_pair(texture, exemplar, 1) for texture in textures]
    images = [image for image, _ in pairs]
    for image in images:
        if image.shape != images[0].shape:
            raise ValueError(
                f"textures of {_size(images[0])} and {_size(image)} px cannot be compared; "
                "give results of one size"
            )
    pixels = pairs[0][1].flatten(1)
    order = torch.randperm(pixels.shape[1], generator=torch.Generator().manual_seed(seed))
    unit = (pixels - pixels[:, order.to(pixels.device)]).abs().mean()
    gaps = [(a - b).abs().mean() for a, b in combinations(images, 2)]
    return float(torch.stack(gaps).mean() / unit)


def battery(
    texture: Float[Tensor, "c h w"],
    exemplar: Float[Tensor, "c hz wz"],
    *,
    tileable: bool = False,
    exact: bool = False,
    seed: int = 0,
) -> dict[str, float]:
    """All measures of one texture; one search serves `nn`, `miss` and `copy`.

    Args:
        tileable: the texture is meant to tile: add `seam` and `seam_worst`, its worst 16 px.
        exact: search every patch in all its dimensions, at about twice the time; the fast way
            is within the margins that `nn`, `miss` and `tail` state.
        seed: of the random directions of `swd`.

    Returns:
        Values by name: nn, tail, miss, swd, spec, copy, repeat.

    Example:
        >>> exemplar = torch.rand(3, 16, 16)
        >>> list(battery(exemplar, exemplar))
        ['nn', 'tail', 'miss', 'swd', 'spec', 'copy', 'repeat']
    """
    found = _match(texture, exemplar, 7, exact)
    values = {
        "nn": found.nn,
        "tail": tail(texture, exemplar, exact=exact),
        "miss": found.miss,
        "swd": swd(texture, exemplar, seed=seed),
        "spec": spec(texture, exemplar),
        "copy": found.copy,
        "repeat": repeat(texture, exemplar),
    }
    if tileable:
        values["seam"] = seam(texture)
        values["seam_worst"] = seam(texture, segment=min(16, *texture.shape[1:]))
    return values


@dataclass(frozen=True)
class _Found:
    nn: float
    miss: float
    copy: float


def _match(texture: Tensor, exemplar: Tensor, patch: int, exact: bool) -> _Found:
    texture, exemplar = _pair(texture, exemplar, patch)
    queries, keys, unit = _patches(texture, exemplar, patch)
    ours, theirs = queries, keys
    if not exact:
        values, axes = torch.linalg.eigh((keys.T @ keys).double())
        share = values.clamp(min=0).flip(0).cumsum(0)
        count = int((share < _KEPT * share[-1]).sum()) + 1
        if count + 1 < keys.shape[1]:
            kept = axes.flip(1)[:, :count].to(keys)
            ours, theirs = _project(queries, kept), _project(keys, kept)
    _, labels, used = two_sided_minima(ours, theirs, chunk=_chunk(queries))
    distance = _squared(queries, keys, labels)

    h, w, hz, wz = (n - patch + 1 for n in (*texture.shape[1:], *exemplar.shape[1:]))
    site = torch.arange(h * w, device=labels.device)
    down, right = labels // wz - site // w, labels % wz - site % w
    roots = _components((down * (w + wz) + right).view(h, w))
    area = torch.bincount(roots, minlength=h * w)[roots]
    copied = (area.double() / (hz * wz)).clamp(max=1).mean()
    return _Found(float(distance.mean() / unit), float(used.mean() / unit), float(copied))


def _squared(
    queries: Float[Tensor, "n d"], keys: Float[Tensor, "m d"], labels: Int[Tensor, "n"]
) -> Float[Tensor, "n"]:
    # exact, without the cancellation in |q|^2 + |k|^2 - 2 q.k; in parts, to save memory
    parts = zip(torch.split(queries, 65536), torch.split(labels, 65536), strict=True)
    return torch.cat([(part - keys[label]).square_().sum(1) for part, label in parts])


def _chunk(queries: Tensor) -> int:
    # one core is fastest when the distances stay in its cache; several threads need more rows
    # each, or they mostly wait for one another, above all on a busy machine
    threads = torch.get_num_threads()
    return 4096 if queries.is_cuda else 128 if threads == 1 else 256 * threads


def _project(patches: Float[Tensor, "n d"], axes: Float[Tensor, "d q"]) -> Float[Tensor, "n q+1"]:
    # with the norm of what the axes leave out, distances stay lower bounds but see noise
    inside = patches @ axes
    rest = patches.square().sum(1) - inside.square().sum(1)
    return torch.cat([inside, rest.clamp(min=0).sqrt()[:, None]], 1)


def _components(value: Int[Tensor, "h w"]) -> Int[Tensor, "n"]:
    """The first pixel of each pixel's 4-connected region of equal value.

    Roots hook on to a smaller neighbouring root, then every pixel jumps to its root's root until
    nothing changes; the number of roots at least halves in each round.
    """
    root = torch.arange(value.numel(), device=value.device)
    site = root.view_as(value)
    across, below = value[:, 1:] == value[:, :-1], value[1:] == value[:-1]
    a = torch.cat([site[:, 1:][across], site[1:][below]])
    b = torch.cat([site[:, :-1][across], site[:-1][below]])
    while True:
        left, right = root[a], root[b]
        apart = left != right
        if not bool(apart.any()):
            return root
        a, b, left, right = a[apart], b[apart], left[apart], right[apart]
        low, high = torch.minimum(left, right), torch.maximum(left, right)
        root = root.scatter_reduce(0, high, low, "amin")
        while not torch.equal(jumped := root[root], root):
            root = jumped


def _patches(
    texture: Float[Tensor, "c h w"], exemplar: Float[Tensor, "c hz wz"], size: int
) -> tuple[Float[Tensor, "n d"], Float[Tensor, "m d"], Float[Tensor, ""]]:
    queries, keys = (F.unfold(x[None], size)[0].T for x in (texture, exemplar))
    mean = keys.mean(0)  # small numbers cancel less in |q|^2 + |k|^2 - 2 q.k
    queries, keys = (queries - mean).contiguous(), (keys - mean).contiguous()
    return queries, keys, keys.square().sum(1).mean()


def _quantiles(values: Float[Tensor, "n m"], count: int) -> Float[Tensor, "n q"]:
    ordered = values.sort(1).values
    last = ordered.shape[1] - 1
    place = (torch.arange(count, dtype=torch.float64, device=values.device) + 0.5) / count * last
    below = place.floor().long()
    above = (below + 1).clamp(max=last)
    return torch.lerp(ordered[:, below], ordered[:, above], (place - below).to(values))


def _spectrum(image: Float[Tensor, "c h w"], size: int) -> Float[Tensor, "size size"]:
    image = image - image.mean((1, 2), keepdim=True)
    hann = torch.hann_window(size, dtype=image.dtype, device=image.device)
    rows, columns = (_starts(n, size).to(image.device) for n in image.shape[1:])
    windows = image[:, rows][:, :, :, columns].transpose(2, 3)  # c, down, across, size, size
    return torch.fft.fft2(windows * hann[:, None] * hann).abs().square().mean((0, 1, 2))


def _starts(length: int, size: int) -> Int[Tensor, "n size"]:
    count = math.ceil((length - size) / (size // 2)) + 1
    first = torch.linspace(0, length - size, count, dtype=torch.float64).round().long()
    starts: Tensor = first[:, None] + torch.arange(size)
    return starts


def _cells(size: int) -> Float[Tensor, "cells bins"]:
    # hard octaves; orientations shade into each other, since a low octave has only 8 bins
    step = torch.fft.fftfreq(size, 1 / size, dtype=torch.float64)
    radius = torch.hypot(step[:, None], step)
    angle = torch.atan2(step[:, None], step.expand(size, size)) / (math.pi / _ORIENTATIONS)
    octave = radius.clamp(min=0.5).log2().floor().clamp(max=size.bit_length() - 3)
    weights = []
    for k in range(size.bit_length() - 2):
        for orientation in range(_ORIENTATIONS):
            turn = (angle - orientation) % _ORIENTATIONS
            near = 1 - torch.minimum(turn, _ORIENTATIONS - turn)
            weights.append((near.clamp(min=0) * (octave == k)).flatten())
    cells = torch.stack(weights)
    return cells / cells.sum(1, keepdim=True)


def _far_autocorrelation(image: Float[Tensor, "c h w"], side: int) -> float:
    grey = rgb_to_grayscale(image) if image.shape[0] == 3 else image.mean(0, keepdim=True)
    sigma = side / 16
    taps = 2 * math.ceil(3 * sigma) + 1
    low = gaussian_blur2d(grey[None], (taps, taps), (sigma, sigma), border_type="replicate")
    detail = grey[0] - low[0, 0]
    detail = detail - detail.mean()
    power = detail.square().mean()
    if power < 1e-10:  # far below a step of 8 bits
        return 0.0
    h, w = detail.shape
    twice = (2 * h, 2 * w)  # zeros around, so that nothing wraps
    sums = torch.fft.irfft2(torch.fft.rfft2(detail, s=twice).abs().square(), s=twice)
    down, right = (_lags(n).to(detail.device) for n in (h, w))
    overlap = (h - down).clamp(min=0)[:, None] * (w - right).clamp(min=0)
    far: Bool[Tensor, "lags lags2"] = torch.maximum(down[:, None], right) >= side / 4
    return float((sums / (overlap * power))[far & (overlap >= _OVERLAP * h * w)].max())


def _lags(length: int) -> Float[Tensor, "lags"]:
    lags: Tensor = torch.fft.fftfreq(2 * length, 1 / (2 * length)).abs()
    return lags


def _pair(texture: Tensor, exemplar: Tensor, patch: int) -> tuple[Tensor, Tensor]:
    if patch < 1:
        raise ValueError(f"patch={patch} must be at least 1 pixel, such as 7")
    texture = _image("texture", texture, patch + 1)
    exemplar = _image("exemplar", exemplar, patch + 1)
    if texture.shape[0] != exemplar.shape[0]:
        raise ValueError(
            f"texture has {texture.shape[0]} channels, exemplar {exemplar.shape[0]}; "
            "convert one to the channels of the other"
        )
    if bool((exemplar == exemplar[:, :1, :1]).all()):
        raise ValueError(
            "exemplar is a single flat colour, which gives no unit to measure in; "
            "give one with some texture"
        )
    dtype = torch.promote_types(texture.dtype, exemplar.dtype)
    return texture.to(dtype), exemplar.to(dtype)


def _image(name: str, image: Tensor, least: int) -> Tensor:
    if image.ndim != 3:
        raise ValueError(
            f"{name} has shape {tuple(image.shape)}; give one image of shape (channels, height, "
            "width)"
        )
    if not image.is_floating_point():
        raise ValueError(f"{name} has dtype {image.dtype}; convert it to floats in 0..1")
    if min(image.shape[1:]) < least:
        raise ValueError(
            f"{name} of {_size(image)} px is too small; give {least} px or more on each side"
        )
    if not bool(torch.isfinite(image).all()):
        raise ValueError(f"{name} holds NaN or infinite values; replace them first")
    # half precision is too coarse for sums of squares
    return image.detach().to(torch.promote_types(image.dtype, torch.float32))


def _size(image: Tensor) -> str:
    return f"{image.shape[-2]} x {image.shape[-1]}"
