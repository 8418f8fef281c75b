"""Lightness for analogies: one image made as light as another, and texture transfer.

Source: Hertzmann et al. 2001, section 3.4; Efros and Freeman 2001, section 3.
"""

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.image import check_image, luminance
from torchtex.recipes.analogy import Analogy


def match_luminance(
    image: Float[Tensor, "c h w"], like: Float[Tensor, "k y x"], by: Tensor | None = None
) -> Float[Tensor, "c h w"]:
    """An image whose lightness has the mean and the deviation of another's; hues are kept.

    Y <- (Y - mean(Y)) dev(Y_like) / dev(Y) + mean(Y_like), the same step in every channel

    Args:
        by: the image whose lightness is measured instead of the image's own. With `by=mapped`
            source and mapped go through one map, as in Image Analogies.

    Source: Hertzmann et al. 2001, section 3.4.

    Example:
        >>> grey = match_luminance(torch.rand(1, 9, 9), torch.full((1, 4, 4), 0.25))
        >>> round(grey.mean().item(), 4)
        0.25
    """
    own, of, other = luminance(image), luminance(image if by is None else by), luminance(like)
    deviation = of.std(correction=0)
    gain = torch.where(deviation > 0, other.std(correction=0) / deviation.clamp(min=1e-12), 1)
    return (image + ((own - of.mean()) * gain + other.mean() - own)).clamp(0, 1)


def luminance_matched(problem: Analogy) -> Analogy:
    """The problem, its sources and first mapped images as light as the first constraint.

    Source: Hertzmann et al. 2001, section 3.4.

    Example:
        >>> s, q, c = torch.rand(3, 8, 9), torch.rand(1, 8, 9), torch.full((1, 5, 6), 0.25)
        >>> round(luminance_matched(Analogy.of(s, q, c)).mapped[0][0].mean().item(), 4)
        0.25
    """
    like = problem.constraints[0]
    pairs = list(zip(problem.sources, problem.mapped, strict=True))
    return replace(
        problem,
        sources=tuple(match_luminance(s, like, by=q[0]) for s, q in pairs),
        mapped=tuple((match_luminance(q[0], like), *q[1:]) for _, q in pairs),
    )


def transfer_problem(
    source: Float[Tensor, "c h w"],
    target: Float[Tensor, "k y x"],
    *,
    blur: float = 0.0,
    match: bool = False,
    contrast: float = 1.0,
) -> Analogy:
    """Texture transfer: the target shown in a texture, by lightness.

    Args:
        blur: deviation, in pixels, of a Gaussian that both lightnesses are blurred by.
        match: give the target's lightness the mean and deviation of the source's first, since
            a texture cannot show what is lighter or darker than itself.
        contrast: times the deviation of the target's lightness, in the end. A portrait with
            `match` was clearest at 1.8: the source's rare tones are then used too.

    Raises:
        ValueError: as `Analogy`, or `blur` is negative, or `contrast` not positive.

    Source: Efros and Freeman 2001, section 3; Ramanarayanan and Bala 2007, section V-E.

    Example:
        >>> transfer_problem(torch.rand(3, 20, 20), torch.rand(3, 9, 8), blur=1.0).size
        (9, 8)
    """
    check_image(source, "source")
    check_image(target, "target")
    if not 0 <= blur < math.inf:
        raise ValueError(f"blur={blur} must be at least 0, and finite")
    if not 0 < contrast < math.inf:
        raise ValueError(f"contrast={contrast} must be above 0, and finite")
    mapped, constraint = luminance(source)[None], luminance(target)[None]
    if blur > 0:
        mapped, constraint = _blurred(mapped, blur), _blurred(constraint, blur)
    constraint = match_luminance(constraint, mapped) if match else constraint
    if contrast != 1:
        mean = constraint.mean()
        constraint = ((constraint - mean) * contrast + mean).clamp(0, 1)
    return Analogy.of(source, mapped, constraint)


def _blurred(image: Tensor, sigma: float) -> Tensor:
    reach = max(1, math.ceil(3 * sigma))
    line = torch.arange(-reach, reach + 1, dtype=image.dtype, device=image.device)
    kernel = torch.exp(-0.5 * (line / sigma).square())
    kernel = (kernel / kernel.sum())[None, None]
    x = F.pad(image[:, None], (reach, reach, reach, reach), mode="replicate")
    return F.conv2d(F.conv2d(x, kernel[:, :, None]), kernel[..., None])[:, 0]
