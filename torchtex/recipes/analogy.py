"""The problem of an analogy: Q is to S as C is to the output O.

S is the source, Q the mapped source and C the constraint; whatever copies a pixel of S into O
copies the pixel of Q beside it into O_Q, and O is good if O_Q looks like C and O has no seams.
`labelings.py` says what such copies are, and `analogy_costs.py` what they cost.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.image import check_image


@dataclass(frozen=True)
class Analogy:
    """Sources with their mapped sources, and the constraints that the output shall meet.

    Args:
        sources: (c, h_j, w_j) images, all with as many channels.
        mapped: for each source a tuple of one (c_k, h_j, w_j) image per constraint.
        constraints: (c_k, H, W) images of the size of the output.
        weights: of the constraints; empty for 1 each.
        masks: for each source its usable pixels, True, or None for all; empty for all of all.
            `cms` and `random_placement` copy no others; the windows that are compared see them.

    Raises:
        ValueError: sizes, channels or counts that do not fit, or NaN; in one sentence.

    Source: Ramanarayanan and Bala 2007, section IV; Hertzmann et al. 2001 (Image analogies).

    Example:
        >>> s, q, c = torch.rand(3, 8, 8), torch.rand(1, 8, 8), torch.rand(1, 6, 9)
        >>> Analogy((s, s), ((q,), (q,)), (c,)).size
        (6, 9)
    """

    sources: tuple[Tensor, ...]
    mapped: tuple[tuple[Tensor, ...], ...]
    constraints: tuple[Tensor, ...]
    weights: tuple[float, ...] = ()
    masks: tuple[Bool[Tensor, "_ _"] | None, ...] = ()

    def __post_init__(self) -> None:
        if not self.sources or not self.constraints:
            raise ValueError("source or constraint: none given; give at least one of each")
        if self.weights and len(self.weights) != len(self.constraints):
            raise ValueError(
                f"weights: {len(self.weights)} given for {len(self.constraints)} constraints; "
                "give one each"
            )
        for weight in self.weights:
            if not 0 < weight < math.inf:
                raise ValueError(f"weights={weight} must be above 0, and finite")
        if len(self.mapped) != len(self.sources):
            raise ValueError(
                f"mapped: {len(self.mapped)} given for {len(self.sources)} sources; "
                "give one for every source"
            )
        self._check_constraints()
        self._check_masks()
        for source, images in zip(self.sources, self.mapped, strict=True):
            self._check_source(source, images)

    @staticmethod
    def of(
        source: Float[Tensor, "c h w"],
        mapped: Float[Tensor, "k h w"],
        constraint: Float[Tensor, "k y x"],
    ) -> "Analogy":
        """The usual case: one of each.

        Example:
            >>> Analogy.of(torch.rand(3, 8, 8), torch.rand(1, 8, 8), torch.rand(1, 5, 6)).size
            (5, 6)
        """
        return Analogy((source,), ((mapped,),), (constraint,))

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the output."""
        return self.constraints[0].shape[1], self.constraints[0].shape[2]

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of each source."""
        return tuple((s.shape[1], s.shape[2]) for s in self.sources)

    def guide(self) -> Float[Tensor, "k h w"]:
        """All constraints as one image, each times the root of its weight."""
        return self._stacked(self.constraints)

    def guides(self, source: int) -> Float[Tensor, "k hz wz"]:
        """All mapped images of a source as one, on the scale of `guide`."""
        return self._stacked(self.mapped[source])

    def _stacked(self, images: Sequence[Tensor]) -> Tensor:
        weights = self.weights or (1.0,) * len(images)
        return torch.cat([x * math.sqrt(w) for x, w in zip(images, weights, strict=True)])

    def _check_constraints(self) -> None:
        for constraint in self.constraints:
            check_image(constraint, "constraint")
            _same_type(constraint, self.sources[0], "constraint")
            if constraint.shape[1:] != self.constraints[0].shape[1:]:
                raise ValueError(
                    f"constraint: one is {size_words(constraint)} and another "
                    f"{size_words(self.constraints[0])}; make them the same size"
                )

    def _check_masks(self) -> None:
        if self.masks and len(self.masks) != len(self.sources):
            raise ValueError(
                f"masks: {len(self.masks)} given for {len(self.sources)} sources; give one each, "
                "or None for a source that is usable everywhere"
            )
        for mask, source in zip(self.masks, self.sources, strict=False):
            if mask is not None and mask.shape != source.shape[1:]:
                raise ValueError(
                    f"masks: one is {size_words(mask[None])} and its source "
                    f"{size_words(source)}; make them the same size"
                )
            if mask is not None and not bool(mask.any()):
                raise ValueError("masks: one is False everywhere; mark usable pixels as True")

    def _check_source(self, source: Tensor, images: Sequence[Tensor]) -> None:
        check_image(source, "source")
        _same_type(source, self.sources[0], "source")
        if len(source) != len(self.sources[0]):
            raise ValueError(
                f"source: one has {len(source)} channels and another {len(self.sources[0])}; "
                "convert them to the same"
            )
        if len(images) != len(self.constraints):
            raise ValueError(
                f"mapped: a source has {len(images)} for {len(self.constraints)} constraints; "
                "give one for every constraint"
            )
        for image, constraint in zip(images, self.constraints, strict=True):
            check_image(image, "mapped")
            _same_type(image, source, "mapped")
            if image.shape[1:] != source.shape[1:]:
                raise ValueError(
                    f"mapped is {size_words(image)} and its source {size_words(source)}; "
                    "make them the same size"
                )
            if len(image) != len(constraint):
                raise ValueError(
                    f"mapped has {len(image)} channels and its constraint {len(constraint)}; "
                    "make both grey or both coloured"
                )


def _same_type(image: Tensor, like: Tensor, name: str) -> None:
    if image.dtype != like.dtype or image.device != like.device:
        raise ValueError(
            f"{name} is {image.dtype} on {image.device} beside {like.dtype} on {like.device}; "
            "convert them to the same"
        )


def size_words(image: Tensor) -> str:
    """Rows and columns of an image, for a sentence.

    Example:
        >>> size_words(torch.ones(3, 4, 5))
        '4x5'
    """
    return f"{image.shape[1]}x{image.shape[2]}"
