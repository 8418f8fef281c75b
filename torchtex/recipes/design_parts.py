"""Parts of designs: sets of deformed textures, large ones made of them, sources carried through.

Source: Shen et al. 2006, Completion-based texture design, section 3.1; Shen et al. 2010, Texture
design by energy optimization, section 3.1.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.features import Wavelets
from torchtex.layers.deform import Deformation, Spread, deform
from torchtex.layers.plans import Chaos, Plan
from torchtex.layers.segment import Method, Segmentation, segment
from torchtex.quadratic import threads
from torchtex.recipes.completion import complete
from torchtex.recipes.graphcut import graphcut
from torchtex.recipes.layered import Filling, layered
from torchtex.recipes.montage import Montage, Stage
from torchtex.result import Progress
from torchtex.sources import copied, pixel_places
from torchtex.synthesize import synthesize

Enlarge = Literal["graphcut", "wavelet", "layers"]
ENLARGE: tuple[Enlarge, ...] = ("graphcut", "wavelet", "layers")
_NEAR = 1.6  # pixels between the sources of neighbours that are taken to be one piece


@dataclass(frozen=True)
class Layering:
    """How textures are taken apart and put together again.

    Args:
        layers, method: of `segment`.
        chaos: how operations are drawn.
        plan: operations, instead of drawn ones, for every piece of the exemplar; for one texture
            of the exemplar's size.
        children, band: of `layered`.
        filling: how holes are completed.

    Example:
        >>> Layering(layers=4).method
        'graph'
    """

    layers: int = 3
    method: Method = "graph"
    chaos: Chaos = field(default_factory=Chaos)
    plan: Plan | None = None
    children: bool = True
    band: int = 6
    filling: Filling = field(default_factory=Filling)


def layers_of(zs: Sequence[Tensor], layering: Layering) -> list[Segmentation]:
    """The layers of every exemplar.

    Example:
        >>> z = torch.zeros(1, 24, 24)
        >>> z[:, 8:16, 8:16] = 1
        >>> layers_of([z], Layering(2))[0].count
        2
    """
    return [segment(z, layering.layers, method=layering.method) for z in zs]


def deformed(
    zs: Sequence[Tensor],
    segmentations: Sequence[Segmentation],
    size: tuple[int, int] | None,
    layering: Layering,
    spread: Spread | None,
    poisson: bool,
    seed: int,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """A texture with deformed layers, of exemplars that are deformed as a whole before, or not.

    Args:
        size: None for a texture of the size of an exemplar, which is drawn where there are several.

    Example:
        >>> z = torch.zeros(1, 48, 48) + 0.1 * torch.rand(1, 48, 48)
        >>> z[:, 10:24, 12:30] += 0.8
        >>> given = Layering(2), Spread(rotate=(-9.0, 9.0)), False, 0
        >>> deformed([z], layers_of([z], given[0]), None, *given).texture.shape
        torch.Size([1, 48, 48])
    """
    generator = torch.Generator().manual_seed(seed)
    pairs = list(zip(zs, segmentations, strict=True))
    if size is None:
        number = int(torch.randint(len(pairs), (1,), generator=generator))
        order = [number]
    else:
        order = list(range(len(pairs)))
    bases = [itself(zs, n) for n in order]
    made = [segmentations[n] for n in order]
    if spread is not None:
        bases, made = [], []
        for n in order:
            drawn = spread.draw(generator)
            bases.append(whole_deformed(zs, n, drawn, layering.filling, seed))
            made.append(segment(bases[-1].texture, layering.layers, method=layering.method))
    done = layered(
        [base.texture for base in bases],
        made,
        size,
        chaos=layering.chaos,
        plan=layering.plan,
        children=layering.children,
        band=layering.band,
        filling=layering.filling,
        poisson=poisson,
        seed=seed,
        on_step=on_step,
    )
    return onto(done, bases, zs, done.texture if poisson else None)


def whole_deformed(
    zs: Sequence[Tensor], number: int, deformation: Deformation, filling: Filling, seed: int = 0
) -> Montage:
    """An exemplar deformed as a whole; what the valid region leaves open is completed from it.

    Example:
        >>> z = torch.rand(3, 40, 40)
        >>> made = whole_deformed([z], 0, Deformation(rotate=20.0), Filling(patch=12))
        >>> torch.equal(made.apply(z), made.texture)
        True
    """
    z = zs[number]
    made = deform(z, deformation)
    positions = made.field.positions[len(made.field.positions) // 2].float()
    nothing = torch.zeros(made.mask.shape, dtype=torch.long, device=z.device)
    shapes = _shapes([z])
    done = Montage(made.texture, copied(positions, shapes), nothing, 0.0, seed, {})
    if not bool(made.mask.all()):
        done = complete(
            made.texture, ~made.mask, source=z, patch=min(filling.patch, *z.shape[1:]),
            order=filling.order, search=filling.search, rim=filling.rim, poisson=False,
            positions=positions, seed=seed,
        )  # fmt: skip
    return onto(done, [itself(zs, number)], zs, None)


def enlarged(
    zs: Sequence[Tensor],
    parts: Sequence[Montage],
    size: tuple[int, int],
    enlarge: Enlarge,
    poisson: bool,
    seed: int,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """A large texture from a set of small ones, with positions in the exemplars.

    Example:
        >>> z = torch.rand(3, 32, 32)
        >>> part = whole_deformed([z], 0, Deformation(mirror=True), Filling())
        >>> enlarged([z], [part], (40, 50), "graphcut", False, 0).texture.shape
        torch.Size([3, 40, 50])
    """
    images = [part.texture for part in parts]
    if enlarge == "graphcut":
        made = graphcut(images, size, poisson=poisson, seed=seed, on_step=on_step)
        return onto(made, parts, zs, made.texture)

    def tell(progress: Progress) -> None:
        if on_step is not None:
            on_step(Stage(progress.done, progress.note, progress.texture, progress.detail))

    solved = synthesize(images, size, feature=Wavelets(), seed=seed, on_step=tell)
    places = solved.source_map
    labels = places[..., 0]
    made = Montage(solved.texture, copied(places, _shapes(images)), labels, 0.0, seed, {})
    return onto(made, parts, zs, solved.texture)


def onto(
    made: Montage, parts: Sequence[Montage], zs: Sequence[Tensor], texture: Tensor | None
) -> Montage:
    """A montage of montages as one of exemplars; its pixels are read from them, or given.

    Between pixels of a part its sources are interpolated where they lie beside each other, so
    that nothing is resampled twice.

    Example:
        >>> z = torch.rand(1, 8, 8)
        >>> part = whole_deformed([z], 0, Deformation(mirror=True), Filling())
        >>> twice = whole_deformed([part.texture], 0, Deformation(mirror=True), Filling())
        >>> torch.equal(onto(twice, [part], [z], None).texture, z)
        True
    """
    outer = made.field.positions[0]
    found = torch.zeros(outer.shape, device=outer.device)
    for number, part in enumerate(parts):
        here = outer[..., 0] == number
        found[here] = _through(part.field.positions[0].float(), outer[here][:, 1:])
    nearest = found.round()
    field = copied(nearest.long() if torch.equal(nearest, found) else found, _shapes(zs))
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
    return Montage(z, copied(places, _shapes(zs)), torch.zeros_like(places[..., 0]), 0.0, 0, {})


def _shapes(zs: Sequence[Tensor]) -> list[tuple[int, int]]:
    return [(z.shape[1], z.shape[2]) for z in zs]
