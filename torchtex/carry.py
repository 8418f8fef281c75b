"""What one level hands to the next: sharp pixels picked by its labels."""

from collections.abc import Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from torchtex.image import resize
from torchtex.label_spaces import label_space
from torchtex.labels import LabelField
from torchtex.model import TextureModel
from torchtex.neighborhoods import Grid
from torchtex.sources import copied


def carried(
    field: LabelField,
    x: Tensor,
    exemplars: Sequence[Tensor],
    masks: Sequence[Tensor | None],
    grid: Grid,
) -> Tensor:
    """The texture of the next scale, rendered from the labels of the last one.

    The labels point into the sharp exemplar, so detail comes back at once; an enlarged texture
    would be blurred, and blurred neighborhoods match the dull parts of the exemplar.
    """
    factors = (grid.height / x.shape[1], grid.width / x.shape[2])
    wide = round(field.grid.size * factors[0])
    shapes = tuple((z.shape[1], z.shape[2]) for z in exemplars)
    space = label_space(shapes, wide, masks, device=x.device)
    if wide > min(grid.height, grid.width) or not len(space):
        return resize(x, (grid.height, grid.width))
    finer = Grid(grid.height, grid.width, wide, max(1, wide // 4), grid.periodic)
    positions = _carried_positions(field, finer, factors, shapes)
    lost = space.at(positions) < 0
    if bool(lost.any()):  # a mask that leaves no place there
        positions[lost] = space.positions[0]
    weights = (~lost).to(x) + 1e-6
    return LabelField(finer, positions, weights, shapes).apply(exemplars)


def weighed_field(
    model: TextureModel, labels: Tensor, x: Tensor, exemplars: Sequence[Tensor]
) -> LabelField:
    """Labels of a level with the robust weights that they have at x."""
    energy = model.energy(labels)
    weights = energy.site_weights(energy.distances(x))
    shapes = tuple((z.shape[1], z.shape[2]) for z in exemplars)
    return LabelField(model.grid, model.space.positions[labels], weights, shapes)


def composed(field: LabelField, exemplars: Sequence[Tensor]) -> Tensor:
    """Every pixel from the window that weighs most: sharp, with seams for the next level to mend.

    Where large windows disagree their mean is blurred, and the small windows that follow would
    match the blur to whatever is flat in the exemplar.
    """
    return copied(field.source_map(), field.shapes).apply(exemplars)


def _carried_positions(
    field: LabelField,
    finer: Grid,
    factors: tuple[float, float],
    shapes: Sequence[tuple[int, int]],
) -> Int[Tensor, "n 3"]:
    old, half = field.grid, finer.size / 2
    device = field.positions.device
    picks, shifts = [], []
    for axis, (sites, olds) in enumerate(((finer.rows, old.rows), (finer.cols, old.cols))):
        centres = (sites + half) / factors[axis]
        gaps = centres[:, None] - (olds + old.size / 2)[None]
        pick = gaps.abs().argmin(1)
        picks.append(pick.to(device))
        shifts.append(gaps.gather(1, pick[:, None])[:, 0].to(device))
    place = field.positions.view(*old.shape, 3)[picks[0]][:, picks[1]]
    which = place[..., 0]
    limits = torch.tensor(shapes, device=device)[which] - finer.size
    row = (place[..., 1] + old.size / 2 + shifts[0][:, None]) * factors[0] - half
    col = (place[..., 2] + old.size / 2 + shifts[1][None]) * factors[1] - half
    spots = torch.stack([row, col], -1).round().long().clamp(min=0)
    spots = torch.minimum(spots, limits)
    return torch.cat([which[..., None], spots], -1).view(-1, 3)
