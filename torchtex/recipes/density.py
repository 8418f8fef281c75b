"""More or fewer elements: flowers are taken from a meadow, or planted in it where there is room.

Elements that go are completed with patches of the ground, which holds no element. New ones are
copies of elements that the picture has, whole ones, mirrored and turned by quarters; each goes to a
place where it touches no other, is cut out by a min-cut and levelled by a Poisson solve.

Source: Shen et al. 2010, section 5.4 and figure 12; how elements are chosen and placed is ours.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.cuts.mincut import MinCut
from torchtex.image import check_image
from torchtex.inputs import check_pair, check_seed
from torchtex.layers.elements import Elements, find_elements
from torchtex.patches import box_sums, summed_area
from torchtex.quadratic import threads
from torchtex.recipes.completion import complete
from torchtex.recipes.graphcut import graphcut
from torchtex.recipes.local_edit import Objects, edit
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.planting import planted, thinned
from torchtex.recipes.strokes import distance
from torchtex.sources import copied, pixel_places

_PATCHES = (32, 24, 16, 12)
_PLACES = 64  # of a patch on the ground, so that it does not repeat
_RIM = 3  # pixels around an element that are not taken for ground
_DRIFT = 12  # pixels, from which on a change of level is no matter of a seam
_BAND = 4  # pixels around a new element where the cut decides
_LARGEST = 1000.0
_ROOM = 0.6  # side of the patches that ground must have room for, of a typical element's
_SPARSE = 0.2  # of the picture that elements cover where all else may be taken for ground
_OTHERS = "; if other elements are meant, find them by at, mask or another number of colors"
_PLAIN = 0.75  # mean step from pixel to pixel on a plain ground, of that of the picture


def density(
    image: Float[Tensor, "c h w"],
    amount: float | Float[Tensor, "_ _"],
    *,
    elements: Elements | None = None,
    ground: Float[Tensor, "_ _ _"] | None = None,
    size: tuple[int, int] | None = None,
    gap: int = 2,
    turn: bool = True,
    poisson: bool = True,
    solver: MinCut | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """The picture with another number of elements, or one of another size with so many.

    Args:
        image: (c, h, w) in [0, 1].
        amount: how many times as many elements there are to be, or a map of that: 0 takes all
            away, 0.5 every other one, 1 leaves them, 2 adds as many again.
        elements: those of the picture; found by their colours unless given.
        ground: what is seen where elements go; otherwise the picture's own ground.
        size: (height, width) of a new picture: all ground at first, on which elements are put so
            densely as they are in the image, times `amount`. None changes the image itself.
        gap: pixels between a new element and any other, at least.
        turn: new elements are turned by quarters and mirrored; otherwise they stand as they do.
        poisson: even out levels at the borders; False copies pixels.
        solver: of the min-cuts; the first one that is installed unless given.
        seed: of which elements go, and what comes where.
        on_step: called after each step; raise from it to cancel.

    Returns:
        A montage; exemplar 0 of its field is the image and 1 the ground, if one is given. Its
        settings hold the numbers of elements `before`, `removed`, `added` and `after`.

    Raises:
        ValueError: an amount that is none, or more than fits, with the number that does; elements
            of another size, or so close together that there is no ground between them, as in a
            heap of pebbles; no whole element to copy.
        ImportError: without `elements`, if the extra `design` is not installed.

    Example:
        >>> image = 0.2 + 0.1 * torch.rand(1, 48, 48)
        >>> image[:, 10:18, 8:16] = image[:, 30:38, 26:34] = 1.0
        >>> density(image, 2.0, seed=1).settings["after"]
        4
    """
    began = time.perf_counter()
    check_image(image)
    check_seed(seed)
    shape = (image.shape[1], image.shape[2])
    factor = _factor(amount, shape if size is None else size)
    if gap < 0:
        raise ValueError(f"gap={gap} must be at least 0 pixels")
    if ground is not None:
        check_pair(image, ground, "ground")
    if elements is None:
        elements = find_elements(image, seed=seed)
    if elements.labels.shape != image.shape[1:]:
        raise ValueError(
            f"elements are of a picture of {tuple(elements.labels.shape)} and the image has "
            f"{tuple(image.shape[1:])} pixels; find those of this image"
        )
    generator = torch.Generator().manual_seed(seed)
    if size is None:
        gone = thinned(elements, factor, generator)
        stays = elements.labels.cpu().clone()
        stays[torch.isin(stays, torch.tensor(gone, dtype=torch.long))] = 0
        more = (factor - 1).clamp(min=0)
        if bool(more.any()):
            _check_room(elements, image)
    else:
        gone, stays, more = [], torch.zeros(size, dtype=torch.long), factor
    plants = planted(elements, stays, more, gap, turn, generator)
    watch = _Watch(on_step, len(plants) / (len(plants) + 3 * bool(len(gone)) + 1e-9))
    base, positions = image, F.pad(pixel_places(shape, image.device), (1, 0))
    patches = torch.zeros(shape, dtype=torch.long, device=image.device)
    if len(gone) or size is not None:
        if size is None:
            done = _cleared(image, elements, gone, ground, poisson, solver, seed, watch.removing)
        else:
            done = graphcut(
                image if ground is None else ground,
                size,
                mirrors=turn,
                poisson=poisson,
                masks=_free(elements, image) if ground is None else None,
                solver=solver,
                seed=seed,
                on_step=watch.removing,
            )
        base, positions, patches = done.texture, done.field.positions[0], done.patches
        if size is not None and poisson:
            base = _level(base, done.apply(image if ground is None else ground))
        if size is not None and ground is not None:  # which is exemplar 1
            positions = positions + positions.new_tensor([1, 0, 0])
    texture, count = base, int(patches.max())
    if plants:
        pasted = edit(
            base,
            [new.stroke(elements) for new in plants],
            reference=image,
            band=_BAND,
            objects=Objects(doubt=0.0),
            poisson=poisson,
            solver=solver,
            on_step=watch.adding,
        )
        texture, own = pasted.texture, pasted.field.positions[0]
        new = own[..., 0] == 1
        positions = positions.to(torch.promote_types(positions.dtype, own.dtype))
        copied_from = torch.stack([torch.zeros_like(own[..., 0]), own[..., 1], own[..., 2]], -1)
        positions = torch.where(new[..., None], copied_from.to(positions), positions)
        patches = torch.where(new, pasted.patches + count, patches)
    settings = {
        "recipe": "density",
        "amount": amount if isinstance(amount, (int, float)) else "map",
        "before": elements.count,
        "removed": len(gone),
        "added": len(plants),
        "after": int(len(stays.unique()) - bool((stays == 0).any())) + len(plants),
        "gap": gap,
        "turn": turn,
        "poisson": poisson,
    }
    whole = bool((positions == positions.round()).all())
    shapes = [shape] if ground is None else [shape, (ground.shape[1], ground.shape[2])]
    field = copied(positions.round().long() if whole else positions, shapes)
    return Montage(texture, field, patches, time.perf_counter() - began, seed, settings)


@dataclass(frozen=True)
class _Watch:
    """Both stages as one run."""

    on_step: Callable[[Stage], None] | None
    share: float  # of adding

    def removing(self, stage: Stage) -> None:
        if self.on_step is not None:
            done = (1 - self.share) * stage.done
            self.on_step(Stage(done, "elements removed", stage.texture, stage.detail))

    def adding(self, stage: Stage) -> None:
        if self.on_step is not None:
            done = 1 - self.share * (1 - stage.done)
            self.on_step(Stage(done, "elements added", stage.texture, stage.detail))


def _factor(amount: float | Tensor, size: tuple[int, int]) -> Tensor:
    if isinstance(amount, Tensor):
        if tuple(amount.shape) != size:
            raise ValueError(
                f"amount is a map of {tuple(amount.shape)} and the image has {size} pixels; "
                "make them the same size"
            )
        factor = amount.detach().cpu().double()
    else:
        factor = torch.full(size, float(amount), dtype=torch.float64)
    if not bool(((factor >= 0) & (factor <= _LARGEST)).all()):
        least, most = float(factor.min()), float(factor.max())
        shown = f"{least:g}..{most:g}" if isinstance(amount, Tensor) else f"{amount:g}"
        raise ValueError(f"amount={shown} must lie in 0..{_LARGEST:g}")
    return factor


def _cleared(
    image: Tensor,
    elements: Elements,
    gone: list[int],
    ground: Tensor | None,
    poisson: bool,
    solver: MinCut | None,
    seed: int,
    on_step: Callable[[Stage], None],
) -> Montage:
    """The picture without some of its elements."""
    labels = elements.labels.to(image.device)
    leaving = torch.isin(labels, torch.tensor(gone, device=image.device))
    hole = (distance(leaving, _RIM) <= _RIM) & ~((labels > 0) & ~leaving)
    free, side = None, min(_PATCHES[0], *image.shape[1:])
    if ground is None:
        free = _free(elements, image)
        side = _patch(free)
    else:
        side = min(side, *ground.shape[1:])
    places = F.pad(pixel_places(image.shape[1:], image.device), (1, 0))
    return complete(
        image,
        hole,
        source=image if ground is None else ground,
        source_masks=free,
        patch=side,
        positions=places.to(image) if ground is None else None,
        tolerance=0.1,
        rim=2,
        poisson=poisson,
        solver=solver,
        seed=seed,
        on_step=on_step,
    )


def _level(levelled: Tensor, plain: Tensor) -> Tensor:
    """What a Poisson solve does along seams, without the slow drift of colours over all of it."""
    from kornia.filters import gaussian_blur2d

    change = levelled - plain
    width = min(6 * _DRIFT + 1, 2 * ((min(plain.shape[1:]) - 1) // 2) + 1)
    with threads(1):
        slow = gaussian_blur2d(change[None], (width, width), (_DRIFT, _DRIFT), "replicate")[0]
    return (plain + change - slow).clamp(0, 1)


def _free(elements: Elements, image: Tensor) -> Tensor:
    """Where the ground is, if it is more than gaps between elements."""
    free = distance(elements.labels.to(image.device) > 0, _RIM) > _RIM
    if not _patch(free) or not _open(free, elements, image):
        raise ValueError(
            f"elements cover {100 * elements.cover:.0f} % of the picture and lie close together, "
            "with no ground between them to put in their place; give a picture of the ground"
            f"{_OTHERS}"
        )
    return free


def _check_room(elements: Elements, image: Tensor) -> None:
    """More of them need ground between those that there are."""
    free = distance(elements.labels.to(image.device) > 0, _RIM) > _RIM
    if elements.count and not _open(free, elements, image):
        raise ValueError(
            f"amount: elements cover {100 * elements.cover:.0f} % of the picture and lie close "
            "together, with no ground between them for more; ask for at most 1, or give a picture "
            f"of the ground and a size{_OTHERS}"
        )


def _open(free: Tensor, elements: Elements, image: Tensor) -> bool:
    """Whether there is a ground: nearly all that is seen, or room for patches and plain.

    In a heap of pebbles, what lies between those of one colour is other pebbles.
    """
    if elements.cover <= _SPARSE:
        return True
    if _patch(free) < min(_PATCHES[0], max(_PATCHES[-1], math.ceil(_ROOM * elements.typical))):
        return False
    steps, inside = [], []
    for axis in (0, 1):
        step, n = image.detach().diff(dim=axis + 1).abs().mean(0), free.shape[axis] - 1
        steps.append(step.flatten())
        inside.append(step[free.narrow(axis, 0, n) & free.narrow(axis, 1, n)])
    return float(torch.cat(inside).mean()) <= _PLAIN * float(torch.cat(steps).mean())


def _patch(free: Tensor) -> int:
    """The largest patch that fits on the ground at some places; 0 for none."""
    table = summed_area(free.double())
    for side in _PATCHES:
        if side > min(free.shape):
            continue
        if int((box_sums(table, side, side) > side * side - 0.5).sum()) >= _PLACES:
            return side
    return 0
