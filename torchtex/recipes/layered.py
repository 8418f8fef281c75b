"""A texture whose layers are deformed, each on its own: a natural variation of the exemplar.

Every child of every layer is moved, turned, mirrored or scaled as a plan says, the larger ones lie
below the smaller ones, seams are cut where they overlap, and holes are completed from the exemplar.

Source: Shen et al. 2006, Completion-based texture design, sections 3.3 and 3.4; Shen et al. 2010,
section 3.4, for the quick search and for several deformed sources.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.inputs import Exemplars, check_seed, check_size, memory_of, usable_exemplars
from torchtex.layers.plans import Chaos, Plan
from torchtex.layers.segment import Segmentation
from torchtex.layers.stitch import Stitched, stitch
from torchtex.quadratic import threads
from torchtex.recipes.completion import Order, complete
from torchtex.recipes.layer_pieces import GROUND, Piece, part_of, pieces_of
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.patch_finders import Search
from torchtex.recipes.shares import share
from torchtex.sources import copied

_LEAST = 60  # pixels of a thing
_EDGE = 2  # pixels at the border of a thing that may change
_STEP = 1_000_003  # from the seed of a design to those of its parts


@dataclass(frozen=True)
class Filling:
    """How holes are completed: options of `complete`.

    Example:
        >>> Filling(patch=24).search
        'fft'
    """

    patch: int = 32
    order: Order = "scan"
    search: Search = "fft"
    tolerance: float = 0.0
    rim: int = 4

    def plain(self) -> dict[str, Any]:
        """The same as plain values."""
        search = self.search if isinstance(self.search, str) else repr(self.search)
        return {**{k: v for k, v in vars(self).items() if k != "search"}, "search": search}


def layered(
    exemplars: Exemplars,
    segmentations: Sequence[Segmentation],
    size: tuple[int, int] | None = None,
    *,
    chaos: Chaos | None = None,
    plan: Plan | None = None,
    children: bool = True,
    band: int = 6,
    collar: int = 6,
    filling: Filling | None = None,
    poisson: bool = False,
    solver: MinCut | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """A deformed texture, of the exemplar's size or of any other.

    A larger size holds several copies of the exemplars, side by side, each deformed otherwise.

    Args:
        exemplars: one image, or several.
        segmentations: their layers, of `segment`.
        size: (height, width); that of the first exemplar unless given.
        chaos: how operations are drawn; `Chaos()` unless given.
        plan: operations, one list for every piece; instead of drawn ones. A piece is a child
            layer, or a layer without `children`, in the order of their numbers. Small ones that
            the border of the exemplar cuts off stay where they are, or in a larger texture are
            left out.
        children: deform the children of a layer each on its own, rather than the layer.
        band: of `stitch`.
        collar: pixels around a piece that come with it, for seams to run through.
        filling: how holes are completed.
        poisson: even out levels where holes were completed; `apply` does not do that. Where holes
            are large it tints what is far from the layers.
        solver: of the min-cuts; None for the first one that is installed.
        seed: of the plan; 0 begins where the paper does.
        on_step: called after each stage and patch; raise from it to cancel.

    Returns:
        A montage of positions in the exemplars; `settings["plan"]` holds the operations.

    Raises:
        ValueError: a layer of the one exemplar that is nowhere seen after deformation, a plan for
            another number of pieces, or segmentations that do not fit.

    Example:
        >>> from torchtex.layers.segment import segment
        >>> z = torch.zeros(1, 48, 48) + 0.1 * torch.rand(1, 48, 48)
        >>> z[:, 10:24, 12:30] += 0.8
        >>> made = layered(z, [segment(z, 2)], filling=Filling(patch=16))
        >>> made.texture.shape, len(made.settings["plan"])
        (torch.Size([1, 48, 48]), 2)
    """
    began = time.perf_counter()
    zs, _ = usable_exemplars(exemplars)
    _check(zs, segmentations)
    check_seed(seed)
    size = (zs[0].shape[1], zs[0].shape[2]) if size is None else size
    check_size(size, memory_of(zs[0], size, images=9, numbers=10))
    solver = default_solver() if solver is None else solver
    filling = Filling() if filling is None else filling
    generator = torch.Generator().manual_seed(seed)
    with threads(1):
        pieces = pieces_of(zs, segmentations, size, children, generator)
        order = sorted(range(len(pieces)), key=lambda n: -pieces[n].area)
        used = (chaos or Chaos()).plan(len(pieces), seed) if plan is None else plan
        made = _stitched(zs, pieces, used, order, size, band, collar, solver, set())
        gone = set() if len(zs) > 1 else _vanished(pieces, order, made.owner)
        if gone:  # too small for seams to be cut in it
            made = _stitched(zs, pieces, used, order, size, band, collar, solver, gone)
            gone = _vanished(pieces, order, made.owner)
        if gone:
            raise ValueError(
                f"layer {min(gone) + 1} vanished: its pieces are covered or lie outside after "
                "deformation; lower the ranges, change the plan or take fewer layers"
            )
        if on_step is not None:
            on_step(Stage(0.5, "layers", made.texture.clone()))
        done = _completed(zs, made.texture, made.holes, made.positions, filling, poisson, solver,
                          seed, on_step)  # fmt: skip
        # pieces were read from parts of the exemplars, which rounds otherwise
        texture = done.texture if poisson else done.apply(zs)
    settings = {
        "recipe": "layered", "size": list(size), "layers": [s.count for s in segmentations],
        "children": children, "band": band, "collar": collar, "filling": filling.plain(),
        "poisson": poisson,
        "chaos": asdict(chaos or Chaos()), "plan": used.plain(),
        "holes": int(made.holes.sum()), "pasted": done.settings.get("pasted", 0),
        "energy": done.settings.get("energy", 0.0),
    }  # fmt: skip
    owner = torch.tensor([-1, *order], device=made.owner.device)[made.owner + 1]
    patches = torch.where(done.patches > 0, done.patches + len(pieces) - 1, owner)
    seconds = time.perf_counter() - began
    return Montage(texture, done.field, patches, seconds, seed, settings)


def _stitched(
    zs: Sequence[Tensor],
    pieces: Sequence[Piece],
    plan: Plan,
    order: Sequence[int],
    size: tuple[int, int],
    band: int,
    collar: int,
    solver: MinCut,
    whole: set[int],
) -> Stitched:
    """All pieces laid down, those of some layers whole."""
    if len(plan.layers) != len(pieces):
        raise ValueError(
            f"plan has {len(plan.layers)} lists of operations for {len(pieces)} pieces; give one "
            "each"
        )
    parts = [
        part_of(zs[pieces[n].exemplar], pieces[n], plan.layers[n], size, collar) for n in order
    ]
    parts = [
        replace(part, whole=pieces[n].layer in whole) for n, part in zip(order, parts, strict=True)
    ]
    return stitch(parts, size, band=band, gradient=True, solver=solver)


def part_seed(seed: int, number: int) -> int:
    """The seed of one part of a design.

    Example:
        >>> part_seed(0, 0), part_seed(1, 2)
        (0, 1000005)
    """
    return (seed * _STEP + number) % 2**63


def _completed(
    zs: Sequence[Tensor],
    texture: Tensor,
    holes: Tensor,
    positions: Float[Tensor, "h w 3"],
    filling: Filling,
    poisson: bool,
    solver: MinCut,
    seed: int,
    on_step: Callable[[Stage], None] | None,
) -> Montage:
    side = min(filling.patch, *holes.shape, *(n for z in zs for n in z.shape[1:]))

    if not bool(holes.any()):
        shapes = [(z.shape[1], z.shape[2]) for z in zs]
        return Montage(
            texture, copied(positions, shapes), torch.zeros_like(holes).long(), 0.0, seed, {}
        )
    return complete(
        texture,
        holes,
        source=list(zs),
        patch=side,
        order=filling.order,
        search=filling.search,
        tolerance=filling.tolerance,
        rim=filling.rim,
        apart=side // 2,
        poisson=poisson,
        positions=positions,
        solver=solver,
        seed=seed,
        on_step=share(on_step, 0.5, 0.5),
    )


def things_of(made: Montage) -> Int[Tensor, "h w"]:
    """Where the pieces of a layered texture are still seen: their numbers, and -1 elsewhere.

    The ground is none, nor is what is left of a piece that is hardly seen.

    Args:
        made: of `layered`, or the same with sources carried through.

    Example:
        >>> from torchtex.layers.segment import segment
        >>> z = torch.zeros(1, 48, 48) + 0.1 * torch.rand(1, 48, 48)
        >>> z[:, 10:24, 12:30] += 0.8
        >>> made = layered(z, [segment(z, 2)], filling=Filling(patch=16))
        >>> things_of(made).unique().tolist()
        [-1, 1]
    """
    count, patches = len(made.settings["plan"]), made.patches
    area = torch.bincount(patches.flatten(), minlength=count)[:count]
    seen = (area >= _LEAST) & (area < GROUND * patches.numel())
    thing = (patches < count) & seen[patches.clamp(max=count - 1)]
    numbers = torch.where(thing, patches, -1)
    wide = F.pad(numbers[None].double(), (_EDGE,) * 4, mode="replicate")
    side = 2 * _EDGE + 1
    inside = F.max_pool2d(wide, side, 1) == -F.max_pool2d(-wide, side, 1)
    return torch.where(inside[0], numbers, -1)


def _check(zs: Sequence[Tensor], segmentations: Sequence[Segmentation]) -> None:
    if len(segmentations) != len(zs):
        raise ValueError(
            f"segmentations: {len(segmentations)} given for {len(zs)} exemplars; give one each"
        )
    for z, made in zip(zs, segmentations, strict=True):
        if made.labels.shape != z.shape[1:]:
            raise ValueError(
                f"segmentation is {made.labels.shape[0]}x{made.labels.shape[1]} and its exemplar "
                f"{z.shape[1]}x{z.shape[2]}; segment that exemplar"
            )
        if made.count < 2:
            raise ValueError("segmentation has one layer only; at least two are needed")


def _vanished(pieces: Sequence[Piece], order: Sequence[int], owner: Tensor) -> set[int]:
    """The layers that are seen nowhere."""
    shown = {pieces[order[n]].layer for n in owner.unique().tolist() if n >= 0}
    return {piece.layer for piece in pieces} - shown
