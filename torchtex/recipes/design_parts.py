"""Parts of designs: sets of deformed textures, large ones made of them, sources carried through.

Source: Shen et al. 2006, Completion-based texture design, section 3.1; Shen et al. 2010, Texture
design by energy optimization, section 3.1.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.features import Wavelets
from torchtex.layers.deform import Deformation, Spread, deform
from torchtex.layers.plans import Chaos, Plan
from torchtex.layers.segment import Method, Segmentation, segment
from torchtex.quadratic import threads
from torchtex.recipes.carried import itself, onto, shapes_of
from torchtex.recipes.completion import complete
from torchtex.recipes.cyclic import cyclic
from torchtex.recipes.graphcut import graphcut
from torchtex.recipes.layered import Filling, layered, part_seed, things_of
from torchtex.recipes.mending import Mending, mended
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.shares import share
from torchtex.result import Progress
from torchtex.sources import copied
from torchtex.synthesize import synthesize

Enlarge = Literal["graphcut", "wavelet", "layers"]
ENLARGE: tuple[Enlarge, ...] = ("graphcut", "wavelet", "layers")
_PLACE = 24  # pixels of an exemplar that are liked alike
_LAYER = 0.5  # how much a layer is liked, beside a place
_TASTE = 500_000  # number of the part of a design's seed that its taste is drawn with


@dataclass(frozen=True)
class Layering:
    """How textures are taken apart and put together again.

    Args:
        layers, method: of `segment`.
        chaos: how operations are drawn.
        plans: operations, instead of drawn ones, for every piece: one plan for each small
            texture, or one for layers over all of the large one.
        children, band, collar: of `layered`.
        filling: how holes are completed.
        mending: how seams are mended after that.
        variety: how much a design prefers some layers to others when it chooses among pieces that
            fit: 0 shows all of them alike, so designs differ in their arrangement alone.

    Raises:
        ValueError: a variety outside 0..10.

    Example:
        >>> Layering(layers=4).method
        'graph'
    """

    layers: int = 3
    method: Method = "graph"
    chaos: Chaos = field(default_factory=Chaos)
    plans: tuple[Plan, ...] = ()
    children: bool = True
    band: int = 6
    collar: int = 6
    filling: Filling = field(default_factory=Filling)
    mending: Mending = field(default_factory=Mending)
    variety: float = 0.9

    def __post_init__(self) -> None:
        if not 0 <= self.variety <= 10:
            raise ValueError(f"variety={self.variety} must lie in 0..10; 0 is none")


def layers_of(zs: Sequence[Tensor], layering: Layering) -> list[Segmentation]:
    """The layers of every exemplar.

    Example:
        >>> z = torch.zeros(1, 24, 24)
        >>> z[:, 8:16, 8:16] = 1
        >>> layers_of([z], Layering(2))[0].count
        2
    """
    return [segment(z, layering.layers, method=layering.method) for z in zs]


def taste_of(
    segmentations: Sequence[Segmentation], variety: float, seed: int
) -> list[Float[Tensor, "_ _"]] | None:
    """For every exemplar, what matches cost there is multiplied by; its layers differ by chance.

    Example:
        >>> labels = torch.tensor([[0, 1]])
        >>> taste_of([Segmentation(labels, labels)], 0.0, 0) is None
        True
        >>> taste_of([Segmentation(labels, labels)], 1.0, 0)[0].shape
        torch.Size([1, 2])
    """
    if variety == 0:
        return None
    generator = torch.Generator().manual_seed(part_seed(seed, _TASTE))
    found = []
    for made in segmentations:
        likes = torch.randn(made.count, generator=generator, dtype=torch.float64)
        size = made.labels.shape
        coarse = [max(2, round(n / _PLACE)) for n in size]
        places = torch.randn(1, 1, *coarse, generator=generator, dtype=torch.float64)
        with threads(1):
            field = F.interpolate(places, size, mode="bicubic", align_corners=True)[0, 0]
        liked = _standard(field) + _LAYER * _standard(likes[made.labels.cpu()])
        found.append(torch.exp(-variety * liked).to(made.labels.device))
    return found


def _standard(x: Tensor) -> Tensor:
    return (x - x.mean()) / x.std(correction=0).clamp(min=1e-6)


def bases_of(
    zs: Sequence[Tensor],
    layering: Layering,
    spread: Spread | None,
    seed: int,
    only: int | None = None,
) -> list[Montage]:
    """What layers are taken from: the exemplars, deformed as a whole if there is a spread.

    Args:
        only: number of the one that is wanted; None for all.

    Example:
        >>> made = bases_of([torch.rand(1, 40, 40)], Layering(), Spread(mirror=1.0), 0)
        >>> made[0].source_map[0, 0].tolist()
        [0, 0, 39]
    """
    generator = torch.Generator().manual_seed(seed)
    order = list(range(len(zs))) if only is None else [only]
    if spread is None:
        return [itself(zs, n) for n in order]
    return [whole_deformed(zs, n, spread.draw(generator), layering.filling, seed) for n in order]


def deformed(
    zs: Sequence[Tensor],
    segmentations: Sequence[Segmentation],
    bases: Sequence[Montage],
    size: tuple[int, int] | None,
    layering: Layering,
    seed: int,
    on_step: Callable[[Stage], None] | None = None,
    *,
    plan: Plan | None = None,
) -> Montage:
    """A texture of deformed layers of the exemplars, or of what they have become as a whole.

    Args:
        bases: of `bases_of`; those that are an exemplar have its layers.
        size: None for that of the first one.
        plan: operations, instead of drawn ones.

    Example:
        >>> z = torch.zeros(1, 48, 48) + 0.1 * torch.rand(1, 48, 48)
        >>> z[:, 10:24, 12:30] += 0.8
        >>> how = Layering(2)
        >>> bases = bases_of([z], how, Spread(rotate=(-9.0, 9.0)), 0)
        >>> deformed([z], layers_of([z], how), bases, None, how, 0).texture.shape
        torch.Size([1, 48, 48])
    """
    made = []
    for base in bases:
        number = int(base.source_map[0, 0, 0])
        known = torch.equal(base.texture, zs[number])
        made.append(
            segmentations[number]
            if known
            else segment(base.texture, layering.layers, method=layering.method)
        )
    done = layered(
        [base.texture for base in bases],
        made,
        size,
        chaos=layering.chaos,
        plan=plan,
        children=layering.children,
        band=layering.band,
        collar=layering.collar,
        filling=layering.filling,
        seed=seed,
        on_step=on_step,
    )
    return onto(done, bases, zs, None)


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
    shapes = shapes_of([z])
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
    seed: int,
    on_step: Callable[[Stage], None] | None = None,
    *,
    mending: Mending | None = None,
) -> Montage:
    """A large texture from a set of small ones, with positions in the exemplars.

    Args:
        mending: of what it will be mended by, which is its refinement then.

    Example:
        >>> z = torch.rand(3, 32, 32)
        >>> part = whole_deformed([z], 0, Deformation(mirror=True), Filling())
        >>> enlarged([z], [part], (40, 50), "graphcut", 0).texture.shape
        torch.Size([3, 40, 50])
    """
    images = [part.texture for part in parts]
    if enlarge == "graphcut":
        refine = None if mending is None or mending.count == 0 else 0
        made = graphcut(images, size, refine=refine, seed=seed, on_step=on_step)
        return onto(made, parts, zs, None)

    def tell(progress: Progress) -> None:
        if on_step is not None:
            on_step(Stage(progress.done, progress.note, progress.texture, progress.detail))

    solved = synthesize(images, size, feature=Wavelets(), seed=seed, on_step=tell)
    places = solved.source_map
    labels = places[..., 0]
    done = Montage(solved.texture, copied(places, shapes_of(images)), labels, 0.0, seed, {})
    return onto(done, parts, zs, solved.texture)


def finished(
    whole: Montage,
    zs: Sequence[Tensor],
    bases: Sequence[Montage],
    layering: Layering,
    *,
    overlap: int = 0,
    poisson: bool = False,
    taste: Sequence[Float[Tensor, "_ _"]] | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """A texture closed to a tile, if there is an overlap, and its seams mended.

    Things of a layered texture stay where they fit.

    Args:
        bases: what pieces for mending are taken from.

    Example:
        >>> z = torch.rand(3, 40, 40)
        >>> done = finished(itself([z], 0), [z], [itself([z], 0)], Layering(), overlap=8)
        >>> done.texture.shape
        torch.Size([3, 32, 32])
    """
    held = things_of(whole) if whole.settings.get("recipe") == "layered" else None
    if overlap:
        whole, held = closed(whole, zs, overlap, share(on_step, 0.0, 0.3)), None
    return mended(
        whole, zs, layering.mending, held=held, looks=bases, taste=taste, periodic=overlap > 0,
        poisson=poisson, seed=seed, on_step=share(on_step, 0.3, 0.7),
    )  # fmt: skip


def closed(
    whole: Montage,
    zs: Sequence[Tensor],
    overlap: int,
    on_step: Callable[[Stage], None] | None = None,
    *,
    solved: bool = False,
) -> Montage:
    """A texture made to tile, by seams in an overlap.

    Args:
        solved: its pixels are a solver's, not those of its sources.

    Example:
        >>> z = torch.rand(3, 40, 40)
        >>> closed(itself([z], 0), [z], 8).texture.shape
        torch.Size([3, 32, 32])
    """
    done = cyclic(whole.texture, overlap=(overlap, overlap), poisson=solved, on_step=on_step)
    return onto(done, [whole], zs, done.texture if solved else None)
