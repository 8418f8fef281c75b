"""What is given: exemplars, masks, sizes and seeds checked; places for blocks."""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.image import check_image
from torchtex.model import LabelSpace, label_space

Exemplars = Float[Tensor, "c _ _"] | Sequence[Float[Tensor, "c _ _"]]
Masks = Bool[Tensor, "_ _"] | Sequence[Bool[Tensor, "_ _"] | None] | None


def usable_exemplars(
    exemplars: Exemplars, masks: Masks = None
) -> tuple[list[Tensor], list[Tensor | None]]:
    """Exemplars, with 0 where they may not be used, and a mask or None for each.

    What a mask leaves out may be anything, NaN too.

    Raises:
        ValueError: no exemplars, masks that do not fit them, or as `check_exemplars`.
        TypeError: as `check_exemplars`.

    Example:
        >>> zs, keep = usable_exemplars(torch.ones(3, 2, 2), torch.eye(2, dtype=torch.bool))
        >>> zs[0][0].tolist(), len(keep)
        ([[1.0, 0.0], [0.0, 1.0]], 1)
    """
    zs = [exemplars] if isinstance(exemplars, Tensor) else list(exemplars)
    keep = matching_masks(masks, zs)
    zs = [z if m is None else torch.where(m, z, 0) for z, m in zip(zs, keep, strict=True)]
    check_exemplars(zs)
    return [z.detach() for z in zs], keep


def check_exemplars(zs: Sequence[Tensor]) -> None:
    """Refuses exemplars that are no images, or not all of one kind.

    Raises:
        ValueError: none is given, one is no image, or they differ in channels.
        TypeError: numbers of other kinds than float32 or float64, or of both.

    Example:
        >>> check_exemplars([torch.rand(3, 4, 4), torch.rand(1, 4, 4)])
        Traceback (most recent call last):
        ValueError: exemplar: one has 3 channels and another 1; convert them to the same
    """
    if not zs:
        raise ValueError("exemplar: none given; give at least one image")
    for z in zs:
        check_image(z, "exemplar")
        if len(z) != len(zs[0]):
            raise ValueError(
                f"exemplar: one has {len(zs[0])} channels and another {len(z)}; "
                "convert them to the same"
            )
        if z.dtype not in (torch.float32, torch.float64) or z.dtype != zs[0].dtype:
            raise TypeError(
                f"exemplar: {z.dtype} beside {zs[0].dtype}; give all as float32 or all as float64"
            )


def check_pair(base: Tensor, other: Tensor, name: str) -> None:
    """Refuses two pictures that cannot be put together.

    Args:
        name: what an error calls the other one.

    Raises:
        ValueError: one is no image, or they differ in channels or in their kind of number.

    Example:
        >>> check_pair(torch.rand(3, 4, 4), torch.rand(3, 8, 9), "source")
    """
    check_image(base, "base")
    check_image(other, name)
    if len(other) != len(base):
        raise ValueError(
            f"{name} has {len(other)} channels and base {len(base)}; "
            "give both as grey (1) or both as RGB (3)"
        )
    if other.dtype != base.dtype:
        raise ValueError(f"{name} is {other.dtype} and base {base.dtype}; convert one of them")


def matching_masks(masks: Masks, zs: Sequence[Tensor]) -> list[Tensor | None]:
    """A mask, or None, for every exemplar.

    Raises:
        ValueError: another number of masks, a mask of another size, or an empty one.

    Example:
        >>> matching_masks(None, [torch.rand(3, 4, 4)])
        [None]
    """
    if masks is None:
        return [None] * len(zs)
    keep: list[Tensor | None] = [masks] if isinstance(masks, Tensor) else list(masks)
    if len(keep) != len(zs):
        raise ValueError(f"mask: {len(keep)} given for {len(zs)} exemplars; give one each")
    for mask, z in zip(keep, zs, strict=True):
        if mask is None:
            continue
        if mask.shape != z.shape[1:]:
            raise ValueError(
                f"mask is {mask.shape[0]}x{mask.shape[1]} and its exemplar "
                f"{z.shape[1]}x{z.shape[2]}; give a mask of the size of the exemplar"
            )
        if not bool(mask.any()):
            raise ValueError("mask is empty: no pixel of the exemplar may be used; widen it")
    return keep


def check_size(size: tuple[int, int], need: int = 0) -> None:
    """Refuses a size below 1 x 1, or one that memory cannot hold, before any work.

    Args:
        size: (height, width) of the texture.
        need: bytes that making it would take, about.

    Raises:
        ValueError: in one sentence, what is wrong.

    Example:
        >>> check_size((64, 0))
        Traceback (most recent call last):
        ValueError: size=64x0 must be at least 1x1; give height x width
    """
    height, width = size
    if height < 1 or width < 1:
        raise ValueError(f"size={height}x{width} must be at least 1x1; give height x width")
    have = _memory()
    if have is not None and need > have:
        raise ValueError(
            f"size={height}x{width} would need about {need / 2**30:.1f} GiB of memory and "
            f"{have / 2**30:.1f} GiB are there; choose a smaller size"
        )


def memory_of(like: Tensor, size: tuple[int, int], images: int, numbers: int) -> int:
    """Bytes of so many images of that size and kind, and of whole numbers per pixel.

    Example:
        >>> memory_of(torch.rand(3, 8, 8), (10, 10), images=2, numbers=1)
        3200
    """
    return size[0] * size[1] * (images * len(like) * like.element_size() + 8 * numbers)


def check_seed(seed: int) -> None:
    """Refuses a seed that a `torch.Generator` does not take.

    Example:
        >>> check_seed(-1)
        Traceback (most recent call last):
        ValueError: seed=-1 must lie in 0..2^63 - 1
    """
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed={seed} must lie in 0..2^63 - 1")


def check_not_negative(name: str, value: float) -> None:
    """Refuses what is negative, infinite or no number.

    Example:
        >>> check_not_negative("tolerance", -1.0)
        Traceback (most recent call last):
        ValueError: tolerance=-1.0 must be at least 0, and finite
    """
    if not 0 <= value < float("inf"):
        raise ValueError(f"{name}={value} must be at least 0, and finite")


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


def _memory() -> int | None:
    """Bytes of physical memory, where the system tells."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None
