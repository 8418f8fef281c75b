"""Guides, made by functions: exemplars mixed by maps, wanted orientations, wanted shapes.

    synthesize(exemplars, size, guides=[mixing(exemplars, weights), oriented(exemplars, angles)])

Source: Hertzmann et al. 2001 and Kwatra et al. 2005, section 4, for guides ("general controls").
"""

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.controls import Guide
from torchtex.features import Feature
from torchtex.image import check_image, luminance
from torchtex.inputs import check_not_negative, check_seed, usable_exemplars
from torchtex.model import Search
from torchtex.result import Progress, Result, at_full_size
from torchtex.schedule import Level
from torchtex.synthesize import synthesize


def mix(
    exemplars: Sequence[Float[Tensor, "c _ _"]],
    weights: Float[Tensor, "k h w"],
    *,
    weight: float = 4.0,
    grain: float = 12.0,
    masks: Sequence[Bool[Tensor, "_ _"] | None] | None = None,
    feature: Feature | None = None,
    r: float = 0.8,
    completeness: float = 50.0,
    schedule: Sequence[Level] | None = None,
    boundary: Literal["free", "periodic"] = "free",
    search: Search | None = None,
    seed: int = 0,
    on_step: Callable[[Progress], None] | None = None,
) -> Result:
    """Makes a texture that is of one exemplar here and of another there.

    Where a map is grey, features of both stand side by side, in the wanted shares; no pixels are
    cross-faded. The first column of `result.source_map` tells which exemplar a pixel is of.

    Args:
        exemplars: two images or more, of the same channels.
        weights: one map for two exemplars, 0 the first and 1 the second; or one map for each,
            shares that are divided by their sum. Their size is that of the texture.
        weight: of the guide: 0 does not follow the maps, 4 keeps pure areas pure.
        grain: see `mixing`.
        masks, feature, r, completeness, schedule, boundary, search, on_step: see `synthesize`.
        seed: same seed, same machine: same bits.

    Raises:
        ValueError: maps that do not fit the exemplars, or an option out of range.

    Example:
        >>> from torchtex import data
        >>> both = [data.load(name)[:, :48, :48] for name in ("gravel", "grass")]
        >>> ramp = torch.linspace(0, 1, 64).expand(1, 40, 64)
        >>> mix(both, ramp).texture.shape
        torch.Size([1, 40, 64])
    """
    check_seed(seed)
    if isinstance(exemplars, Tensor) or len(exemplars) < 2:
        raise ValueError("exemplars: one given; give at least two, or use synthesize")
    zs, keep = usable_exemplars(exemplars, masks)
    generator = torch.Generator().manual_seed(seed)
    guide = mixing(zs, weights, weight=weight, grain=grain, generator=generator)
    size = (weights.shape[1], weights.shape[2])
    return synthesize(
        zs,
        size,
        masks=keep,
        feature=feature,
        r=r,
        completeness=completeness,
        schedule=schedule,
        boundary=boundary,
        search=search,
        guides=[guide],
        seed=seed,
        on_step=at_full_size(on_step, size),
    )


def mixing(
    exemplars: Sequence[Float[Tensor, "c _ _"]],
    weights: Float[Tensor, "k h w"],
    *,
    weight: float = 4.0,
    grain: float = 12.0,
    generator: torch.Generator | None = None,
) -> Guide:
    """A guide that shares the texture out among exemplars: one constant channel for each.

    A window cannot be half of one exemplar, so grey is shared out in blobs: a random one of the
    exemplars at each place, with the shares as probabilities and neighboring places alike.

    Args:
        exemplars: two images or more.
        weights: one map for two, 0 the first and 1 the second; or one map for each.
        weight: of the guide.
        grain: diameter of the blobs in pixels, about.
        generator: of the blobs; seed 0 unless given.

    Raises:
        ValueError: maps outside 0..1 or not one each, shares that are all 0, or a negative option.

    Example:
        >>> both = [torch.rand(3, 16, 16), torch.rand(3, 20, 16)]
        >>> guide = mixing(both, torch.ones(1, 8, 8))
        >>> guide.texture[:, 0, 0].tolist(), len(guide.exemplars)
        ([0.0, 1.0], 2)
    """
    check_not_negative("weight", weight)
    check_not_negative("grain", grain)
    shares = _shares(weights, len(exemplars))
    like = exemplars[0]
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    ranks = _blobs((shares.shape[1], shares.shape[2]), grain, generator).to(shares)
    # the bounds are exact at both ends: a share of 0 takes no rank at all
    above = shares.cumsum(0)[:-1]
    chosen = (ranks >= above).sum(0)
    chosen = torch.where(shares.amax(0) == 1, shares.argmax(0), chosen)
    wanted = F.one_hot(chosen, len(exemplars)).permute(2, 0, 1).to(like)
    each = [
        F.one_hot(torch.tensor(n), len(exemplars)).to(z)[:, None, None].expand(-1, *z.shape[1:])
        for n, z in enumerate(exemplars)
    ]
    return Guide(each, wanted, weight / 2)  # two channels differ where an exemplar does


def oriented(
    exemplars: Sequence[Float[Tensor, "c _ _"]],
    angles: Float[Tensor, "h w"],
    *,
    weight: float = 0.3,
    sigma: float = 4.0,
) -> Guide:
    """A guide to lines that run in wanted directions: cos 2t and sin 2t of their angle t.

    In an exemplar the two are as long as its structure is coherent: 0 where it has no direction.
    Only what an exemplar holds can be found: add turned copies of it for other directions.

    Args:
        exemplars: images.
        angles: wanted, in radians; 0 is along a row, and a quarter turn counter-clockwise later
            along a column.
        weight: of the guide.
        sigma: of the Gaussian over which a direction is averaged, in pixels.

    Raises:
        ValueError: a sigma that is not above 0, or a negative weight.

    Source: structure tensor, Bigun and Granlund 1987.

    Example:
        >>> rows = torch.sin(torch.arange(32.0))[None, :, None].expand(1, 32, 32)
        >>> guide = oriented([rows], torch.zeros(8, 8))
        >>> bool((guide.exemplars[0][0] > 0.99).all()), guide.texture[:, 0, 0].tolist()
        (True, [1.0, 0.0])
    """
    from kornia.filters import gaussian_blur2d, spatial_gradient

    if not 0 < sigma < math.inf:
        raise ValueError(f"sigma={sigma} must be above 0, and finite")
    side = 2 * math.ceil(2 * sigma) + 1
    found = []
    for z in exemplars:
        across, down = spatial_gradient(luminance(z)[None, None])[0, 0]
        tensor = torch.stack([across.square(), down.square(), across * down])
        border = "replicate"
        a, d, both = gaussian_blur2d(tensor[None], (side, side), (sigma, sigma), border)[0]
        tiny = 1e-6 + torch.zeros_like(a)
        found.append(torch.stack([d - a, 2 * both]) / torch.maximum(a + d, tiny))
    wanted = torch.stack([torch.cos(2 * angles), torch.sin(2 * angles)])
    return Guide(found, wanted.to(found[0]), weight)


def shaped(
    exemplars: Sequence[Bool[Tensor, "_ _"]],
    shape: Bool[Tensor, "h w"],
    *,
    weight: float = 2.0,
    reach: int = 16,
    dtype: torch.dtype = torch.float32,
) -> Guide:
    """A guide to the edge of a shape: how far each pixel lies inside or outside of it.

    What lies on an edge in the exemplar comes to lie on the edge in the texture.

    Args:
        exemplars: True inside the shape, one for each exemplar.
        shape: the same of the texture.
        weight: of the guide.
        reach: pixels from the edge after which all are alike.
        dtype: of the images.

    Raises:
        ValueError: a reach below 1, or a negative weight.

    Example:
        >>> half = (torch.arange(16) < 8).expand(16, 16)
        >>> shaped([half], half, reach=4).texture[0, 0, 5:11].tolist()
        [0.8125, 0.6875, 0.5625, 0.4375, 0.3125, 0.1875]
    """
    if reach < 1:
        raise ValueError(f"reach={reach} must be at least 1 pixel")
    inside = [_depth(mask, reach, dtype) for mask in (*exemplars, shape)]
    return Guide(inside[:-1], inside[-1], weight)


def _shares(weights: Tensor, count: int) -> Tensor:
    check_image(weights, "weights")
    if bool((weights < 0).any()) or bool((weights > 1).any()):
        raise ValueError(
            f"weights lie in {float(weights.min()):g}..{float(weights.max()):g}; scale them to 0..1"
        )
    if len(weights) == 1 and count == 2:
        weights = torch.cat([1 - weights, weights])
    if len(weights) != count:
        raise ValueError(
            f"weights: {len(weights)} maps given for {count} exemplars; give one each, "
            "or one map for two"
        )
    total = weights.sum(0)
    if bool((total <= 0).any()):
        raise ValueError("weights are 0 in all maps at some pixels; give every pixel to one")
    return weights / total


def _blobs(size: tuple[int, int], grain: float, generator: torch.Generator) -> Tensor:
    """Smooth noise whose values are evenly spread in 0..1."""
    from kornia.filters import gaussian_blur2d

    noise = torch.randn(1, 1, *size, generator=generator, dtype=torch.float64)
    sigma = min(grain / 3, min(size) / 4)
    if sigma > 0.3:
        side = min(2 * math.ceil(3 * sigma) + 1, 2 * ((min(size) - 1) // 2) + 1)
        noise = gaussian_blur2d(noise, (side, side), (sigma, sigma))
    order = noise.flatten().argsort(stable=True)
    ranks = torch.empty_like(noise.flatten())
    ranks[order] = (torch.arange(len(order), dtype=torch.float64) + 0.5) / len(order)
    return ranks.view(size)


def _depth(inside: Tensor, reach: int, dtype: torch.dtype) -> Tensor:
    """0 far outside, 1 far inside; grown by squares and by crosses in turn: nearly round."""
    depth = inside.to(dtype) - 0.5
    for mask, sign in ((inside, -1), (~inside, 1)):
        grown = mask[None].to(dtype)
        for step in range(reach):
            grown = _wider(grown, step)
            depth = depth + sign * (1 - grown[0])
    return (depth / (2 * reach) + 0.5).clamp(0, 1)[None]


def _wider(x: Tensor, step: int) -> Tensor:
    if step % 2:
        return F.max_pool2d(x, 3, 1, 1)
    tall, wide = F.max_pool2d(x, (3, 1), 1, (1, 0)), F.max_pool2d(x, (1, 3), 1, (0, 1))
    return torch.maximum(tall, wide)
