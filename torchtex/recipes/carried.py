"""Sources carried through: montages of montages as montages of exemplars."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.quadratic import threads
from torchtex.recipes.montage import Montage
from torchtex.sources import copied, pixel_places

_NEAR = 1.6  # pixels between the sources of neighbours that are taken to be one piece


def onto(
    made: Montage, parts: Sequence[Montage], zs: Sequence[Tensor], texture: Tensor | None
) -> Montage:
    """A montage of montages as one of exemplars; its pixels are read from them, or given.

    Between pixels of a part its sources are interpolated where they lie beside each other, so
    that nothing is resampled twice.

    Example:
        >>> z = torch.rand(1, 8, 8)
        >>> part = itself([z], 0)
        >>> torch.equal(onto(itself([part.texture], 0), [part], [z], None).texture, z)
        True
    """
    outer = made.field.positions[0]
    found = torch.zeros(outer.shape, device=outer.device)
    for number, part in enumerate(parts):
        here = outer[..., 0] == number
        found[here] = _through(part.field.positions[0].float(), outer[here][:, 1:])
    field = copied(whole_places(found), shapes_of(zs))
    with threads(1):
        texture = field.apply(list(zs)) if texture is None else texture
    return replace(made, texture=texture, field=field)


def _through(inner: Float[Tensor, "h w 3"], places: Tensor) -> Float[Tensor, "n 3"]:
    """The sources of places in a part, between its pixels too."""
    nearest = places.round().long()
    exact = inner[nearest[:, 0], nearest[:, 1]]
    if not places.is_floating_point():
        return exact
    limit = nearest.new_tensor(inner.shape[:2]) - 1
    low = places.floor().long()
    high = torch.minimum(low + 1, limit)
    down, right = (places - low).T[..., None]
    corners = [inner[a[:, 0], b[:, 1]] for a in (low, high) for b in (low, high)]
    mixed = (corners[0] * (1 - right) + corners[1] * right) * (1 - down)
    mixed = mixed + (corners[2] * (1 - right) + corners[3] * right) * down
    apart = torch.stack([(corner - exact).abs().amax(1) for corner in corners]).amax(0)
    return torch.where((apart < _NEAR)[:, None] & ((places != nearest).any(1, True)), mixed, exact)


def itself(zs: Sequence[Tensor], number: int) -> Montage:
    """An exemplar as a montage of itself.

    Example:
        >>> z = torch.rand(1, 4, 4)
        >>> torch.equal(itself([z], 0).apply(z), z)
        True
    """
    z = zs[number]
    places = torch.nn.functional.pad(pixel_places(z.shape[1:], z.device), (1, 0), value=number)
    return Montage(z, copied(places, shapes_of(zs)), torch.zeros_like(places[..., 0]), 0.0, 0, {})


def shapes_of(zs: Sequence[Float[Tensor, "c _ _"]]) -> list[tuple[int, int]]:
    """Height and width of every exemplar.

    Example:
        >>> shapes_of([torch.zeros(1, 2, 3)])
        [(2, 3)]
    """
    return [(z.shape[1], z.shape[2]) for z in zs]


def whole_places(positions: Tensor) -> Tensor:
    """Positions as whole numbers, if all of them are.

    Example:
        >>> whole_places(torch.tensor([2.0, 3.0])).dtype
        torch.int64
    """
    nearest = positions.round()
    return nearest.long() if torch.equal(nearest, positions) else positions
