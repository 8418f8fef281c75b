"""Exemplars and templates of a patch search, checked, with 0 where they do not count."""

import torch
from torch import Tensor

from torchtex.image import check_image


def known_exemplar(exemplar: Tensor, usable: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """The exemplar with 0 where it may not be used, and a mask or None.

    Raises:
        ValueError: the exemplar is no image, or its mask is empty or of another size.

    Example:
        >>> known_exemplar(torch.ones(1, 1, 2), torch.tensor([[True, False]]))[0].tolist()
        [[[1.0, 0.0]]]
    """
    if usable is None:
        check_image(exemplar, "exemplar")
        return exemplar, None
    z, m = _known(exemplar, usable, "exemplar", "usable")
    return z, m > 0


def _known(image: Tensor, mask: Tensor, name: str, mask_name: str) -> tuple[Tensor, Tensor]:
    """The image with 0 where its mask is False, and the mask as float64."""
    if image.shape[1:] != mask.shape:
        raise ValueError(
            f"{mask_name} has shape {tuple(mask.shape)}; {name} asks for {tuple(image.shape[1:])}"
        )
    if not bool(mask.any()):
        raise ValueError(f"{mask_name} is False everywhere; mark at least one pixel of {name}")
    image = torch.where(mask, image, 0)
    check_image(image, name)
    return image, mask.double()


def known_template(
    templates: Tensor, mask: Tensor | None, shape: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """Templates with 0 where they do not count, and (1 or n, 1, h, w) weights in float64.

    Args:
        shape: (channels, rows, columns) of the exemplar.

    Raises:
        ValueError: they do not fit the exemplar, or the mask makes no sense.

    Example:
        >>> known_template(torch.ones(2, 1, 3, 3), None, (1, 8, 8))[1].shape
        torch.Size([1, 1, 3, 3])
    """
    n, c, h, w = templates.shape
    if c != shape[0]:
        raise ValueError(f"template has {c} channels and exemplar {shape[0]}; give both the same")
    if h > shape[1] or w > shape[2]:
        raise ValueError(
            f"template of {h} x {w} pixels does not fit in the exemplar of "
            f"{shape[1]} x {shape[2]}; take a smaller patch"
        )
    m = templates.new_ones(h, w) if mask is None else mask
    if m.shape not in ((h, w), (n, h, w)):
        raise ValueError(f"mask has shape {tuple(m.shape)}; the template asks for {(h, w)}")
    m = m.reshape(-1, 1, h, w).double()
    if not bool((m.isfinite() & (m >= 0)).all()):
        raise ValueError("mask holds weights that are negative or not finite; use 0 and above")
    if not bool((m > 0).flatten(1).any(1).all()):
        raise ValueError("mask is 0 everywhere; mark at least one pixel of the template")
    t = torch.where(m > 0, templates, 0)
    if not bool(t.isfinite().all()):
        raise ValueError("template holds NaN or infinity where its mask counts; replace them")
    return t, m
