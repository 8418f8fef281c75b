"""Detail synthesis: a small picture enlarged with the detail of a sharp sample.

Source: Ramanarayanan and Bala 2007, section V-B.
"""

import math

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.image import check_image, luminance, resize
from torchtex.recipes.analogy import Analogy, size_words


def detail_problem(
    sample: Float[Tensor, "c h w"], low: Float[Tensor, "k y x"], factor: int | float
) -> Analogy:
    """Detail for a small picture: S is the sample, Q the sample as coarse as the small picture.

    Args:
        sample: sharp picture of the same kind of thing, at the scale of the output.
        low: the picture to enlarge.
        factor: of enlargement, per side; above 1, up to 10 or so.

    Raises:
        ValueError: as `Analogy`, or another factor.

    Example:
        >>> detail_problem(torch.rand(3, 20, 20), torch.rand(3, 6, 4), 4).size
        (24, 16)
    """
    check_image(sample, "sample")
    check_image(low, "low")
    if not 1 < factor < math.inf:
        raise ValueError(f"factor={factor} must be above 1, and finite")
    h, w = sample.shape[1:]
    if min(h, w) < factor:
        raise ValueError(
            f"sample is {size_words(sample)}, less than factor={factor}; give a larger sample"
        )
    small = shrunk(sample, (round(h / factor), round(w / factor)))
    size = round(low.shape[1] * factor), round(low.shape[2] * factor)
    mapped, constraint = resize(small, (h, w)).clamp(0, 1), resize(low, size).clamp(0, 1)
    return Analogy.of(sample, mapped, constraint)


def shrunk(image: Float[Tensor, "c h w"], size: tuple[int, int]) -> Float[Tensor, "c y x"]:
    """A picture reduced by averages over boxes, as a camera of fewer pixels sees it.

    Example:
        >>> shrunk(torch.ones(3, 8, 8), (2, 3)).shape
        torch.Size([3, 2, 3])
    """
    return F.interpolate(image[None], size=size, mode="area")[0]


def detail_error(
    output: Float[Tensor, "c h w"], low: Float[Tensor, "c y x"], factor: int | float
) -> float:
    """Root mean square of the output, reduced, minus the small picture; 0.01 is 1 % of white.

    Raises:
        ValueError: the output is not the small picture enlarged by the factor.

    Example:
        >>> detail_error(torch.full((1, 8, 8), 0.5), torch.full((1, 2, 2), 0.25), 4)
        0.25
    """
    wanted = round(low.shape[1] * factor), round(low.shape[2] * factor)
    if tuple(output.shape[1:]) != wanted:
        raise ValueError(
            f"output is {size_words(output)}; factor={factor} makes {wanted[0]}x{wanted[1]} of low"
        )
    small = shrunk(output, (low.shape[1], low.shape[2]))
    return float((small - low).square().mean().sqrt())


def back_projected(
    output: Float[Tensor, "c h w"], low: Float[Tensor, "c y x"], factor: int | float
) -> Float[Tensor, "c h w"]:
    """The output, its coarse colours corrected so that reduced it is the small picture.

    A copy of a sample has only the colours of the sample; the correction is smooth, so that the
    detail stays. Afterwards the pixels are no longer copies.

    Source: Irani and Peleg 1991 (iterative back projection).

    Example:
        >>> x, low = torch.rand(1, 16, 16), torch.full((1, 4, 4), 0.5)
        >>> detail_error(back_projected(x, low, 4), low, 4) < 0.01 < detail_error(x, low, 4)
        True
    """
    detail_error(output, low, factor)  # refuses sizes that do not fit
    for _ in range(5):
        lack = low - shrunk(output, (low.shape[1], low.shape[2]))
        output = (output + resize(lack, (output.shape[1], output.shape[2]))).clamp(0, 1)
    return output


def sharpness_ratio(output: Float[Tensor, "c h w"], source: Float[Tensor, "c hz wz"]) -> float:
    """Mean gradient of the output's lightness over that of the source's; below 1 is blurred.

    Example:
        >>> x = torch.rand(3, 9, 9)
        >>> round(sharpness_ratio(x / 2, x), 4)
        0.5
    """
    return _gradient(output) / max(_gradient(source), 1e-12)


def _gradient(image: Tensor) -> float:
    y = luminance(image).double()
    across, down = y[:-1, 1:] - y[:-1, :-1], y[1:, :-1] - y[:-1, :-1]
    return float((across.square() + down.square()).sqrt().mean())
