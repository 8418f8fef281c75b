"""Blocks that overlap, and the places for them in exemplars."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.label_spaces import LabelSpace, label_space


@dataclass(frozen=True)
class Layout:
    """Square blocks that overlap, from the top left corner on until they cover the size.

    Args:
        size: (height, width) of the texture.
        side: of a block.
        overlap: of neighbors.

    Example:
        >>> Layout((20, 30), 8, 2).count
        (3, 5)
    """

    size: tuple[int, int]
    side: int
    overlap: int

    @property
    def step(self) -> int:
        """From a block to the next."""
        return self.side - self.overlap

    @property
    def count(self) -> tuple[int, int]:
        """Rows and columns of blocks."""
        rows, cols = (1 + max(0, -((self.side - n) // self.step)) for n in self.size)
        return rows, cols

    @property
    def extent(self) -> tuple[int, int]:
        """Pixels under the blocks; those beyond the size are cut off in the end."""
        rows, cols = self.count
        return self.side + (rows - 1) * self.step, self.side + (cols - 1) * self.step

    def window(self, row: int, col: int) -> tuple[slice, slice]:
        """Pixels under one block."""
        top, left = row * self.step, col * self.step
        return slice(top, top + self.side), slice(left, left + self.side)

    def known(self, row: int, col: int, device: torch.device) -> Bool[Tensor, "s s"]:
        """Pixels of one block that those before it cover, row by row."""
        known = torch.zeros(self.side, self.side, dtype=torch.bool, device=device)
        known[: self.overlap * (row > 0)] = known[:, : self.overlap * (col > 0)] = True
        return known

    def shrunk(self, ratio: float) -> "Layout":
        """Smaller blocks for the same size."""
        side = max(3, round(self.side * ratio))
        return Layout(self.size, side, min(max(1, round(self.overlap * ratio)), (side - 1) // 2))

    def padded(self, image: Float[Tensor, "c h w"]) -> Float[Tensor, "c y x"]:
        """The image over the whole extent; its border goes on."""
        below, right = self.extent[0] - image.shape[1], self.extent[1] - image.shape[2]
        return F.pad(image[None], (0, right, 0, below), mode="replicate")[0]


def layout_of(
    zs: Sequence[Float[Tensor, "_ _ _"]],
    size: tuple[int, int],
    side: int | None,
    overlap: int | None,
    *,
    share: float,
    name: str,
) -> Layout:
    """Blocks for a texture of that size, of sides that fit in every exemplar.

    Args:
        side: of a block; None for that share of the shortest side of the exemplars.
        overlap: of neighbors; None for a sixth of the side.
        share: see there.
        name: what an error calls the side.

    Raises:
        ValueError: a side or an overlap out of range.

    Example:
        >>> layout_of([torch.rand(3, 40, 50)], (64, 64), None, None, share=0.3, name="block")
        Layout(size=(64, 64), side=12, overlap=2)
    """
    shortest = min(min(z.shape[1:]) for z in zs)
    height, width = size
    side = max(3, round(share * shortest)) if side is None else side
    if not 3 <= side <= shortest:
        raise ValueError(
            f"{name}={side} must lie in 3..{shortest}, the shortest side of the exemplars"
        )
    if overlap is None:
        overlap = max(1, min(round(side / 6), height // 2, width // 2))
    elif not 1 <= overlap <= min((side - 1) // 2, height // 2, width // 2):
        raise ValueError(
            f"overlap={overlap} must be at least 1, less than half of {name}={side}, and at most "
            f"half of size={height}x{width}"
        )
    return Layout((height, width), side, overlap)


def places_of(
    zs: Sequence[Float[Tensor, "_ _ _"]], masks: Sequence[Tensor | None], side: int, name: str
) -> LabelSpace:
    """All places of a block in the exemplars and their masks.

    Args:
        name: what an error calls the side.

    Raises:
        ValueError: there is none.

    Example:
        >>> len(places_of([torch.rand(3, 10, 12)], [None], 8, "block"))
        15
    """
    space = label_space([(z.shape[1], z.shape[2]) for z in zs], side, masks)
    if not len(space.positions):
        raise ValueError(
            f"{name}={side} fits nowhere in the masks; choose a smaller {name} or wider masks"
        )
    return space


def costs_of_places(space: LabelSpace, costs: Sequence[Float[Tensor, "_ _"]]) -> Float[Tensor, "n"]:
    """Costs of all places, one exemplar after another, out of maps of each exemplar's costs.

    Example:
        >>> space = places_of([torch.rand(1, 4, 5)], [None], 3, "block")
        >>> costs_of_places(space, [torch.arange(6.0).view(2, 3)]).tolist()
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    """
    found = []
    for cost, table in zip(costs, space.tables, strict=True):
        found.append(cost[table[: cost.shape[0], : cost.shape[1]].to(cost.device) >= 0])
    return torch.cat(found)
