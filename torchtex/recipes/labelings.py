"""Labelings of an output: which copy of a source every pixel shows.

A label is a copy of S, turned by quarters or mirrored, laid somewhere over the output. It may be
used where its copy lies. Where a window, or the other pixel of a pair, sticks out of the copy, the
border of the copy goes on; so everywhere here, and in the search of `cms`.

Source: Ramanarayanan and Bala 2007, section IV-B.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.recipes.analogy import Analogy
from torchtex.sources import SourceField, copied, pixel_places


@dataclass(frozen=True)
class Variant:
    """A source and its mapped images, turned or mirrored; made by `variants`.

    Args:
        image: the source.
        mapped: all its mapped images, on the scale of `Analogy.guide`.
        positions: source, row and column that each pixel was.
        shape: rows and columns of the source as it was.
        upright: neither turned nor mirrored.
        usable: pixels that labels may show; None for all.
    """

    image: Float[Tensor, "c h w"]
    mapped: Float[Tensor, "k h w"]
    positions: Int[Tensor, "h w 3"]
    shape: tuple[int, int]
    upright: bool
    usable: Bool[Tensor, "h w"] | None = None


def variants(problem: Analogy, *, turns: bool = True, mirrors: bool = False) -> tuple[Variant, ...]:
    """Every source with its mapped images, in all the ways that labels may turn it.

    Args:
        turns: also by 90, 180 and 270 degrees.
        mirrors: also each of them mirrored.

    Example:
        >>> s, q, c = torch.rand(3, 8, 9), torch.rand(1, 8, 9), torch.rand(1, 5, 6)
        >>> [tuple(v.image.shape) for v in variants(Analogy.of(s, q, c))]
        [(3, 8, 9), (3, 9, 8), (3, 8, 9), (3, 9, 8)]
    """
    made = []
    for number, source in enumerate(problem.sources):
        shape, mapped = problem.shapes[number], problem.guides(number)
        mask = problem.masks[number] if problem.masks else None
        lines = [torch.arange(n, device=source.device) for n in (1, *shape)]
        base = torch.stack(torch.meshgrid(*lines, indexing="ij"))[:, 0]
        base[0] = number
        for turn in range(4 if turns else 1):
            for mirrored in (False, True) if mirrors else (False,):
                parts = [x.rot90(turn, (1, 2)) for x in (source, mapped, base)]
                parts = [(x.flip(2) if mirrored else x).contiguous() for x in parts]
                positions = parts[2].permute(1, 2, 0).contiguous()
                usable = None if mask is None else mask[positions[..., 1], positions[..., 2]]
                upright = turn == 0 and not mirrored
                made.append(Variant(parts[0], parts[1], positions, shape, upright, usable))
    return tuple(made)


@dataclass(frozen=True)
class Labeling:
    """A label for every pixel of the output.

    Args:
        labels: (h, w, 3): number of the variant, and row and column of the output where the
            first pixel of that variant lies; pixel p shows pixel p - offset of the variant.
        variants: that the labels name.

    Raises:
        ValueError: a label names no variant, or a pixel that lies outside it.

    Example:
        >>> problem = Analogy.of(*(torch.rand(1, 4, 4) for _ in range(3)))
        >>> labeling = Labeling(torch.zeros(4, 4, 3).long(), variants(problem))
        >>> bool((render(labeling, problem.sources) == problem.sources[0]).all())
        True
    """

    labels: Int[Tensor, "h w 3"]
    variants: tuple[Variant, ...]

    def __post_init__(self) -> None:
        which = self.labels[..., 0]
        if int(which.min()) < 0 or int(which.max()) >= len(self.variants):
            raise ValueError(
                f"labels name the variants {int(which.min())}..{int(which.max())}; there are "
                f"0..{len(self.variants) - 1}"
            )
        if bool((self.places() != self._places(True)).any()):
            raise ValueError("labels leave their variant; a pixel may have a label that covers it")

    def places(self) -> Int[Tensor, "h w 2"]:
        """Row and column of each pixel in its variant."""
        return self._places(False)

    def _places(self, clamped: bool) -> Tensor:
        h, w = self.labels.shape[:2]
        return _reached(self, 0, 0, slice(0, h), slice(0, w), clamped)


def placed(positions: Int[Tensor, "h w 3"], made: tuple[Variant, ...]) -> Labeling:
    """The labeling of an output whose pixels were copied upright, by any method.

    Args:
        positions: source, row and column of every pixel, such as `Montage.source_map`.
        made: of `variants`.

    Example:
        >>> problem = Analogy.of(*(torch.rand(1, 4, 4) for _ in range(3)))
        >>> placed(torch.zeros(2, 2, 3).long(), variants(problem)).labels[1, 1].tolist()
        [0, 1, 1]
    """
    upright = [i for i, v in enumerate(made) if v.upright]
    which = torch.tensor(upright, device=positions.device)[positions[..., 0]]
    here = pixel_places(positions.shape[:2], positions.device)
    return Labeling(torch.cat([which[..., None], here - positions[..., 1:]], -1), made)


def source_field(labeling: Labeling) -> SourceField:
    """Where every pixel came from, in the sources as they were given.

    Example:
        >>> problem = Analogy.of(*(torch.rand(1, 4, 4) for _ in range(3)))
        >>> whole = Labeling(torch.zeros(4, 4, 3).long(), variants(problem))
        >>> source_field(whole).source_map()[2, 3].tolist()
        [0, 2, 3]
    """
    h, w = labeling.labels.shape[:2]
    flat = Flat.of([v.positions.permute(2, 0, 1) for v in labeling.variants])
    positions = flat.read(labeling, 0, 0, slice(0, h), slice(0, w)).permute(1, 2, 0)
    shapes = {int(v.positions[0, 0, 0]): v.shape for v in labeling.variants}
    return copied(positions, [shapes[j] for j in sorted(shapes)])


def render(labeling: Labeling, images: Sequence[Float[Tensor, "k _ _"]]) -> Float[Tensor, "k h w"]:
    """The output that a labeling makes of one image for each source, of its size.

    Example:
        >>> problem = Analogy.of(*(torch.rand(1, 4, 4) for _ in range(3)))
        >>> whole = Labeling(torch.zeros(3, 2, 3).long(), variants(problem))
        >>> render(whole, [torch.rand(7, 4, 4)]).shape
        torch.Size([7, 3, 2])
    """
    return source_field(labeling).apply(list(images))


def views(labeling: Labeling) -> Float[Tensor, "5 c h w"]:
    """What the label of each pixel shows there and below, right, above and left of it.

    Example:
        >>> problem = Analogy.of(*3 * [torch.rand(1, 6, 6)])
        >>> views(Labeling(torch.zeros(6, 6, 3).long(), variants(problem))).shape
        torch.Size([5, 1, 6, 6])
    """
    h, w = labeling.labels.shape[:2]
    flat = Flat.of([v.image for v in labeling.variants])
    steps = ((0, 0), (1, 0), (0, 1), (-1, 0), (0, -1))
    whole = slice(0, h), slice(0, w)
    return torch.stack([flat.read(labeling, i, j, *whole) for i, j in steps])


@dataclass(frozen=True)
class Flat:
    """Images of all variants, end to end, to be read by label; made by `of`.

    Args:
        values: (k, n) pixels of all images.
        starts, widths: first pixel and width of each image.

    Example:
        >>> problem = Analogy.of(*(torch.rand(1, 4, 4) for _ in range(3)))
        >>> labeling = Labeling(torch.zeros(4, 4, 3).long(), variants(problem))
        >>> flat = Flat.of([v.image for v in labeling.variants])
        >>> flat.read(labeling, 0, 0, slice(0, 2), slice(0, 4)).shape
        torch.Size([1, 2, 4])
    """

    values: Tensor
    starts: Tensor
    widths: Tensor

    @staticmethod
    def of(images: Sequence[Tensor]) -> "Flat":
        """Of one (k, h, w) image per variant."""
        device = images[0].device
        sizes = torch.tensor([x[0].numel() for x in images], device=device)
        widths = torch.tensor([x.shape[2] for x in images], device=device)
        values = torch.cat([x.flatten(1) for x in images], 1)
        return Flat(values, sizes.cumsum(0) - sizes, widths)

    def read(self, labeling: Labeling, down: int, across: int, rows: slice, cols: slice) -> Tensor:
        """What the labels of a part of the output show at a pixel further down and across."""
        which = labeling.labels[rows, cols, 0]
        places = _reached(labeling, down, across, rows, cols, True)
        return self.values[:, self.starts[which] + places[..., 0] * self.widths[which]
                           + places[..., 1]]  # fmt: skip


def _reached(
    labeling: Labeling, down: int, across: int, rows: slice, cols: slice, clamped: bool
) -> Tensor:
    labels = labeling.labels[rows, cols]
    device = labels.device
    corner = labels.new_tensor([rows.start + down, cols.start + across])
    places = pixel_places(labels.shape[:2], device) + corner - labels[..., 1:]
    if not clamped:
        return places
    limits = torch.tensor([v.image.shape[1:] for v in labeling.variants], device=device) - 1
    return torch.minimum(places.clamp(min=0), limits[labels[..., 0]])
