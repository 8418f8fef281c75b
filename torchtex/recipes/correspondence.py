"""Maps that say what a texture should look like where: the correspondence of a transfer."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.image import check_image, luminance
from torchtex.sources import check_maps


@dataclass(frozen=True)
class Correspondence:
    """What a block of the exemplar and the target's pixels under it should have in common.

    Args:
        exemplars: (k, hz, wz) maps, one for each exemplar.
        target: (k, h, w) map of the target.

    Example:
        >>> Correspondence((torch.zeros(1, 8, 8),), torch.zeros(1, 6, 6)).target.shape
        torch.Size([1, 6, 6])
    """

    exemplars: tuple[Tensor, ...]
    target: Float[Tensor, "k h w"]

    def __post_init__(self) -> None:
        for image in (*self.exemplars, self.target):
            check_image(image, "correspondence")
            if len(image) != len(self.target):
                raise ValueError(
                    f"correspondence: {len(image)} channels for an exemplar and "
                    f"{len(self.target)} for the target; give both the same"
                )

    def check(self, exemplars: Sequence[Tensor], size: tuple[int, int]) -> None:
        """Refuses maps that are not aligned with the exemplars, or with a target of that size.

        Raises:
            ValueError: in one sentence, what is wrong.
        """
        check_maps(self.exemplars, [(z.shape[1], z.shape[2]) for z in exemplars])
        if tuple(self.target.shape[1:]) != tuple(size):
            raise ValueError(
                f"correspondence of the target is {self.target.shape[1]}x{self.target.shape[2]} "
                f"and the target {size[0]}x{size[1]}; give a map of the size of the target"
            )


def blurred_luminance(
    exemplars: Sequence[Float[Tensor, "_ _ _"]],
    target: Float[Tensor, "_ h w"],
    *,
    sigma: float = 1.5,
    match: bool = True,
    masks: Sequence[Bool[Tensor, "_ _"] | None] | None = None,
) -> Correspondence:
    """Lightness of both, blurred, as the correspondence of a transfer.

    Args:
        sigma: standard deviation of the Gaussian, in pixels.
        match: give the target the exemplars' distribution of lightness, rank by rank, so that
            the darkest of the one stands for the darkest of the other.
        masks: True at the pixels of the exemplars whose lightness counts in that.

    Raises:
        ValueError: sigma is not above 0.

    Example:
        >>> found = blurred_luminance([torch.rand(3, 16, 16)], torch.rand(1, 20, 24))
        >>> found.target.shape
        torch.Size([1, 20, 24])
    """
    from kornia.filters import gaussian_blur2d

    if not 0 < sigma < float("inf"):
        raise ValueError(f"sigma={sigma} must be above 0, and finite")
    width = 2 * round(3 * sigma) + 1

    def blurred(image: Tensor) -> Tensor:
        grey = luminance(image)[None, None]
        return gaussian_blur2d(grey, (width, width), (sigma, sigma), border_type="replicate")[0]

    theirs = tuple(blurred(z) for z in exemplars)
    ours = blurred(target.to(exemplars[0]))
    if match:
        used = [None] * len(theirs) if masks is None else masks
        seen = [z[0] if m is None else z[0, m] for z, m in zip(theirs, used, strict=True)]
        values = torch.cat([z.flatten() for z in seen]).sort().values
        order = ours.flatten().sort().values
        # equal pixels get equal values: those of the middle of their ranks
        rank = torch.searchsorted(order, ours) + torch.searchsorted(order, ours, right=True)
        ours = values[(rank * len(values) // (2 * len(order))).clamp(max=len(values) - 1)]
    return Correspondence(theirs, ours)
