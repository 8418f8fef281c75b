"""What is given: exemplars, masks, sizes and seeds, checked."""

import os
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.image import check_image

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
    check_memory(f"{height}x{width}", need)


def check_memory(size: str, need: int) -> None:
    """Refuses a size that memory cannot hold, before any work.

    Args:
        size: as an error shows it.
        need: bytes that making it would take, about.

    Raises:
        ValueError: the memory of this machine is less.

    Example:
        >>> check_memory("9x9x9", 2**70)
        Traceback (most recent call last):
        ValueError: size=9x9x9 would need about 1099511627776.0 GiB of memory and ...
    """
    have = _memory()
    if have is not None and need > have:
        raise ValueError(
            f"size={size} would need about {need / 2**30:.1f} GiB of memory and "
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


def _memory() -> int | None:
    """Bytes of physical memory, where the system tells."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None
