"""Maps of regions for texture-by-numbers, whose colours are not quite even.

Source: Hertzmann et al. 2001, section 4.6 (texture-by-numbers).
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.image import check_image


@dataclass(frozen=True)
class Snapped:
    """Label maps whose colours are those of one palette; made by `snapped`.

    Args:
        mapped, constraint: the maps.
        palette: (m, c) colours of the mapped source.
        changed: pixels of mapped and of constraint that had another colour.
    """

    mapped: Float[Tensor, "c h w"]
    constraint: Float[Tensor, "c y x"]
    palette: Float[Tensor, "m c"]
    changed: tuple[int, int]


def snapped(
    mapped: Float[Tensor, "c h w"],
    constraint: Float[Tensor, "k y x"],
    *,
    near: float = 0.1,
    share: float = 0.002,
) -> Snapped:
    """Texture-by-numbers maps with clean colours, whose edges and shades were not quite even.

    The palette holds the colours that many pixels of the mapped source have. A pixel near one of
    them gets it; one between, as on a smooth edge, gets the nearest of those around it.

    Args:
        near: distance, per channel, of colours that count as one.
        share: of the pixels that a colour must have, with those near it, to be one of a palette.

    Raises:
        ValueError: channels differ, there is no palette, or colours of the constraint are none of
            the mapped source's; the sentence lists them.

    Example:
        >>> maps = torch.tensor([0.0, 0.0, 0.1, 1.0, 1.0, 0.9])[None, None].expand(1, 6, 6)
        >>> clean = snapped(maps, 1 - maps, near=0.2)
        >>> clean.palette.flatten().tolist(), clean.changed
        ([0.0, 1.0], (12, 12))
    """
    check_image(mapped, "mapped")
    check_image(constraint, "constraint")
    if len(mapped) != len(constraint):
        raise ValueError(
            f"mapped has {len(mapped)} channels and constraint {len(constraint)}; "
            "make both grey or both coloured"
        )
    if not 0 < near < 1 or not 0 < share < 1:
        raise ValueError(f"near={near} and share={share} must lie between 0 and 1")
    palette = _palette(mapped, near, share)
    if not len(palette):
        raise ValueError(
            "mapped has no colour that many pixels share, so it is no map of regions; "
            "paint each region in one colour"
        )
    used = _palette(constraint, near, share)
    strange = used[(torch.cdist(used, palette, p=torch.inf) > 2 * near).all(1)]
    if len(strange):
        raise ValueError(
            f"constraint has colours that mapped has not: {_listed(strange)}; "
            f"paint it in those of mapped: {_listed(palette)}"
        )
    maps = [_snap(x, palette, near) for x in (mapped, constraint)]
    changed = [int(((a - b).abs().amax(0) > 0.5 / 255).sum())
               for a, b in zip(maps, (mapped, constraint), strict=True)]  # fmt: skip
    return Snapped(maps[0], maps[1], palette, (changed[0], changed[1]))


def _palette(image: Tensor, near: float, share: float) -> Tensor:
    """(m, c): colours of many pixels, the most frequent first of those near each other."""
    colours, counts = (image.flatten(1).T * 255).round().unique(dim=0, return_counts=True)
    order = counts.argsort(descending=True, stable=True)[:4096]
    colours, counts = colours[order] / 255, counts[order]
    kept: list[Tensor] = []
    free = torch.ones(len(colours), dtype=torch.bool, device=image.device)
    for i in range(len(colours)):
        if not bool(free[i]):
            continue
        alike = free & ((colours - colours[i]).abs().amax(1) <= near)
        free &= ~alike
        total = int(counts[alike].sum())
        # colours of soft edges are many and each rare
        if total >= share * image[0].numel() and int(counts[i]) * 4 >= total:
            kept.append(colours[i])
    return torch.stack(kept) if kept else colours[:0]


def _snap(image: Tensor, palette: Tensor, near: float) -> Tensor:
    distances = torch.stack([(image - p[:, None, None]).abs().amax(0) for p in palette])
    sure = (distances <= near).to(image)
    around = F.max_pool2d(sure[None], 5, stride=1, padding=2)[0] > 0
    local = torch.where(around, distances, torch.inf).argmin(0)
    best = torch.where(sure.amax(0) > 0, distances.argmin(0), local)
    best = torch.where(around.any(0), best, distances.argmin(0))
    return palette.T[:, best]


def _listed(colours: Tensor) -> str:
    return ", ".join(
        "(" + ", ".join(str(round(255 * v)) for v in c) + ")" for c in colours.tolist()
    )
