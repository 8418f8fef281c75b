"""First pixels of a synthesis."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.label_spaces import label_space, strips
from torchtex.labels import LabelField
from torchtex.neighborhoods import Grid


@runtime_checkable
class Start(Protocol):
    """First pixels of the coarsest level."""

    def __call__(
        self,
        exemplars: Sequence[Tensor],
        masks: Sequence[Tensor | None],
        grid: Grid,
        generator: torch.Generator,
    ) -> Float[Tensor, "c h w"]: ...


@dataclass(frozen=True)
class Blocks:
    """Random blocks of the coarse exemplar side by side, not averaged.

    Args:
        fraction: side of a block, of the shorter side of the largest exemplar.
    """

    fraction: float = 0.2

    def __post_init__(self) -> None:
        if not 0 < self.fraction <= 1:
            raise ValueError(f"fraction={self.fraction} of blocks must lie in (0, 1]")

    def __call__(
        self,
        exemplars: Sequence[Tensor],
        masks: Sequence[Tensor | None],
        grid: Grid,
        generator: torch.Generator,
    ) -> Float[Tensor, "c h w"]:
        shapes = [(z.shape[1], z.shape[2]) for z in exemplars]
        side = max(2, round(self.fraction * max(min(shape) for shape in shapes)))
        space = label_space(shapes, side, masks)
        while not len(space):  # a mask may leave no room for so large a block
            side = side // 2
            space = label_space(shapes, side, masks)
        ny, nx = -(-grid.height // side), -(-grid.width // side)
        labels = torch.randint(len(space), (ny * nx,), generator=generator)
        blocks = strips(exemplars, space, side).patches(labels.to(exemplars[0].device))
        blocks = blocks.view(ny, nx, side, side, -1).permute(4, 0, 2, 1, 3)
        whole = blocks.reshape(len(exemplars[0]), ny * side, nx * side)
        whole = whole[:, : grid.height, : grid.width].contiguous()
        if grid.periodic:  # else the borders of blocks would lie on that of the texture
            shift = [int(torch.randint(side, (1,), generator=generator)) for _ in range(2)]
            whole = whole.roll(shift, (1, 2))
        return whole


@dataclass(frozen=True)
class RandomNeighborhoods:
    """A random exemplar neighborhood at every site, averaged.

    Source: Kwatra et al. 2005, Algorithm 1.
    """

    def __call__(
        self,
        exemplars: Sequence[Tensor],
        masks: Sequence[Tensor | None],
        grid: Grid,
        generator: torch.Generator,
    ) -> Float[Tensor, "c h w"]:
        shapes = tuple((z.shape[1], z.shape[2]) for z in exemplars)
        space = label_space(shapes, grid.size, masks)
        pick = torch.randint(len(space), (len(grid),), generator=generator)
        weights = torch.ones(len(grid)).to(exemplars[0])
        positions = space.positions[pick].to(weights.device)
        return LabelField(grid, positions, weights, shapes).apply(exemplars)
