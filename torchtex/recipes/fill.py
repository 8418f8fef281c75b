"""Holes in a photo, filled from its own texture.

Three steps for each hole. It is completed patch by patch, in several ways. The EM solver, begun
from the first of them, makes a texture of the hole's surroundings, where the known pixels are a
soft constraint and are put back after every E-step. Both are proposals: the offsets (source less
place) that they chose most often, and those at which the rim of the hole is found again, are
offered to all pixels of the hole, and min-cuts decide who takes them, so that neighbors from unlike
offsets agree where they meet, above all at the border of the hole. Every new pixel is thus a copy
of a known one, as sharp as the photo. A Poisson solve within the hole evens out what difference of
level is left, but for edges between things of unlike colours.

Source: Kwatra et al. 2005, eq. 2 (soft constraints), 2003 (cost of a seam); the energy of offsets
after Pritch et al. 2009, frequent offsets as its labels after He and Sun 2012; Perez et al. 2003.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.controls import SoftConstraint
from torchtex.cuts.expansion import Move
from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.energy import Objective
from torchtex.estep import Auto
from torchtex.features import Feature
from torchtex.image import resize
from torchtex.inputs import check_exemplars, check_not_negative, check_seed
from torchtex.label_spaces import label_space
from torchtex.model import Search
from torchtex.recipes.completion import Order, complete
from torchtex.recipes.hole_boxes import Box, around, boxes_of, shifted
from torchtex.recipes.hole_cut import Hole
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.offsets import fitting, frequent, rim_offsets
from torchtex.result import Progress
from torchtex.schedule import Level
from torchtex.sources import copied, pixel_places
from torchtex.synthesize import synthesize

_LEVELS = (Level(0.5, 16, 4), Level(0.5, 8, 4), Level(1.0, 16, 2), Level(1.0, 8, 3))
_LAID: tuple[tuple[Order, int], ...] = (("confidence", 32), ("confidence", 20), ("scan", 32))
_RIM = 6  # pixels of a hole from its border that have offsets of their own


def fill(
    image: Float[Tensor, "c h w"],
    mask: Bool[Tensor, "_ _"],
    *,
    feature: Feature | None = None,
    r: float = 0.8,
    confidence: float = 10.0,
    offsets: int = 160,
    border: float = 10.0,
    detail: float = 0.05,
    poisson: bool = True,
    reach: int = 256,
    schedule: Sequence[Level] | None = None,
    search: Search | None = None,
    solver: MinCut | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """Fills holes from the rest of the image, coherent with what is around them.

    Known pixels keep their bits. What the holes hold now changes nothing; it may be NaN.
    `result.apply(image)` equals the texture where poisson=False, and `apply` of an aligned map
    fills that map in the same way. `result.patches` is 0 for known pixels, and one number for
    all pixels of one offset in one hole.

    Args:
        image: (c, h, w) in [0, 1].
        mask: True in the holes; of any shape, also at the border of the image.
        feature, r, schedule, search: of the EM solver, see `synthesize`.
        confidence: of the known pixels against the texture energy.
        offsets: how many are offered.
        border: cost of a seam at the border of a hole, against 1 for one inside.
        detail: cost of a pixel from where the image is flatter than around the hole, which seams
            alone would prefer; in proportion to how much flatter.
        poisson: even out the levels along the seams.
        reach: pixels around a hole that are searched for its texture.
        solver: of the min-cuts; the first one that is installed unless given.
        seed: same seed, same machine: same bits.
        on_step: called after each step; raise from it to cancel.

    Raises:
        ValueError: a mask that is empty or full, of another size, or leaves no whole window;
            or an option out of range.

    Example:
        >>> from torchtex import data
        >>> photo = data.load("gravel")[:, :64, :64]
        >>> hole = torch.zeros(64, 64, dtype=torch.bool)
        >>> hole[24:40, 20:44] = True
        >>> result = fill(photo, hole)
        >>> torch.equal(result.texture[:, ~hole], photo[:, ~hole])
        True
    """
    began = time.perf_counter()
    costs = {"confidence": confidence, "border": border, "detail": detail}
    _check(image, mask, costs, offsets, reach, seed)
    levels = tuple(_LEVELS if schedule is None else schedule)
    least = min(level.size for level in levels)
    if not len(label_space([(mask.shape[0], mask.shape[1])], least, [~mask])):
        raise ValueError(
            f"mask leaves no whole window of {least}x{least} known pixels; "
            "make the hole smaller or choose a schedule with smaller windows"
        )
    solver = default_solver() if solver is None else solver
    how = _How(feature, r, confidence, offsets, border, detail, reach, levels, search, solver, seed)
    known = ~mask
    whole = torch.where(known, image.detach(), image[:, known].mean(1)[:, None, None])
    sources = pixel_places(mask.shape, mask.device)
    patches = torch.zeros_like(mask, dtype=torch.long)
    boxes = boxes_of(mask, how.margin)
    areas = [int(mask[box].sum()) for box in boxes]
    for number, box in enumerate(boxes):
        near, wide = around(box, how.margin, reach, known, least)
        target = torch.zeros_like(mask)
        target[box] = mask[box]
        before, share = sum(areas[:number]) / sum(areas), areas[number] / sum(areas)
        watch = _Watch(on_step, whole, near, target, before, share)
        hole = Hole(whole[:, wide[0], wide[1]], known[wide], target[wide])
        places = how.places(hole, shifted(near, -wide[0].start, -wide[1].start), watch)
        filled = hole.pixels(places, poisson=poisson)
        whole[:, wide[0], wide[1]] = torch.where(hole.target, filled, hole.image)
        corner = torch.tensor([wide[0].start, wide[1].start], device=places.device)
        sources[wide][hole.target] = places[hole.target] + corner
        which = hole.moved(places).unique(dim=0, return_inverse=True)[1]
        patches[wide][hole.target] = which + int(patches.max()) + 1
    settings = {
        "recipe": "fill", "pixels": sum(areas), "holes": len(boxes), "feature": repr(feature),
        "r": r, "confidence": confidence, "offsets": offsets, "border": border, "detail": detail,
        "poisson": poisson, "reach": reach,
        "schedule": [[level.scale, level.size, level.steps] for level in levels],
    }  # fmt: skip
    field = copied(F.pad(sources, (1, 0)), [(mask.shape[0], mask.shape[1])])
    return Montage(whole, field, patches, time.perf_counter() - began, seed, settings)


@dataclass(frozen=True)
class _How:
    """Options of `fill`, and what they make of one hole."""

    feature: Feature | None
    r: float
    confidence: float
    offsets: int
    border: float
    detail: float
    reach: int
    levels: tuple[Level, ...]
    search: Search | None
    solver: MinCut
    seed: int

    @property
    def margin(self) -> int:
        """Pixels around a hole that the windows of the solver see."""
        return max(round(level.size / level.scale) for level in self.levels)

    def places(self, hole: Hole, inner: Box, watch: "_Watch") -> Int[Tensor, "h w 2"]:
        """Where pixels of a hole come from; the solver works on the inner part around it."""
        laid = [self._laid(hole, order, side) for order, side in _LAID]
        offered = _offered(hole, self._solved(hole, inner, laid[0], watch), laid, self.offsets)
        told = watch.cut(3 * len(offered))
        return hole.cut(laid[0], offered, self.border, self.detail, self.solver, told)

    def _laid(self, hole: Hole, order: Order, side: int) -> Int[Tensor, "h w 2"]:
        """Places of a hole that was completed patch by patch."""
        done = complete(
            hole.image,
            hole.target,
            source=hole.image,
            source_masks=hole.known,
            patch=fitting(hole.known, side),
            order=order,
            rim=0,
            fresh=0.0,  # what fits best: cuts choose among many
            detail=0.0,
            poisson=False,
            solver=self.solver,
            seed=self.seed,
        )
        return done.source_map[..., 1:]

    def _solved(
        self, hole: Hole, inner: Box, first: Int[Tensor, "h w 2"], watch: "_Watch"
    ) -> Int[Tensor, "h w 2"]:
        """Places of a hole that the EM solver made, begun from others."""
        begun = hole.image[:, first[..., 0], first[..., 1]][:, inner[0], inner[1]]
        held = SoftConstraint(hole.image[:, inner[0], inner[1]], hole.known[inner].to(begun))
        result = synthesize(
            hole.image,
            (begun.shape[1], begun.shape[2]),
            masks=hole.known,
            feature=self.feature,
            r=self.r,
            init=begun,
            schedule=self.levels,
            search=self.search,
            estep=Kept(held),
            controls=[(self.confidence, held)],
            seed=self.seed,
            on_step=watch.solved,
        )
        places = pixel_places(hole.known.shape, hole.known.device)
        places[inner] = result.source_map[..., 1:]
        return places


def _offered(
    hole: Hole, solved: Int[Tensor, "h w 2"], laid: Sequence[Tensor], count: int
) -> Int[Tensor, "k 2"]:
    """Offsets for a hole, no more than so many: of all kinds, the most frequent."""
    patched = torch.cat([hole.moved(places) for places in laid])
    kinds = [
        frequent(patched, -(-count // 4)),
        frequent(hole.moved(solved), -(-count // 4)),
        frequent(hole.moved(solved, _RIM), count // 4),
    ]
    rest = count - sum(len(kind) for kind in kinds)
    if rest > 0:
        kinds.append(rim_offsets(hole.image, hole.known, hole.target, rest))
    return torch.cat(kinds)[:count].unique(dim=0)


@dataclass(frozen=True)
class Kept:
    """An E-step that puts known pixels back.

    Args:
        known: the pixels, with confidence 1 where they are known and 0 elsewhere.

    Example:
        >>> kept = Kept(SoftConstraint(torch.ones(1, 8, 8), torch.eye(8)))
        >>> kept.put(torch.zeros(1, 8, 8)).sum().item()
        8.0
    """

    known: SoftConstraint

    def put(self, x: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        """The pixels with the known ones in their places, at any size."""
        given = self.known
        if given.target.shape != x.shape:
            given = given.at(x.shape[1], x.shape[2])
        return torch.where(given.confidence > 0.95, given.target, x)

    def __call__(self, objective: Objective, x: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        return self.put(Auto()(objective, x))


@dataclass(frozen=True)
class _Watch:
    """Tells `on_step` of the two steps of one hole."""

    tell: Callable[[Stage], None] | None
    whole: Float[Tensor, "c h w"]
    near: Box
    target: Bool[Tensor, "h w"]
    before: float
    share: float

    @property
    def solved(self) -> Callable[[Progress], None] | None:
        if self.tell is None:
            return None
        tell = self.tell

        def report(progress: Progress) -> None:
            preview = self.whole.clone()
            rows, cols = self.near
            size = (rows.stop - rows.start, cols.stop - cols.start)
            preview[:, rows, cols] = resize(progress.texture, size).clamp(0, 1)
            preview = torch.where(self.target, preview, self.whole)
            done = self.before + 0.5 * self.share * progress.done
            tell(Stage(done, progress.note, preview, progress.detail))

        return report

    def cut(self, moves: int) -> Callable[[Move], None] | None:
        if self.tell is None:
            return None
        tell, count = self.tell, 0

        def report(move: Move) -> None:
            nonlocal count
            count += 1
            done = self.before + self.share * (0.5 + 0.5 * count / moves)
            tell(Stage(done, "min-cuts", self.whole, f"energy {move.energy:.4g}"))

        return report


def _check(
    image: Tensor, mask: Tensor, costs: Mapping[str, float], offsets: int, reach: int, seed: int
) -> None:
    if mask.shape != image.shape[1:]:
        raise ValueError(
            f"mask is {mask.shape[0]}x{mask.shape[1]} and image {image.shape[1]}x"
            f"{image.shape[2]}; give a mask of the size of the image"
        )
    if bool(mask.all()) or not bool(mask.any()):
        state = "nowhere" if not bool(mask.any()) else "everywhere"
        raise ValueError(
            f"mask is True {state}; mark the holes, and leave pixels to fill them from"
        )
    check_exemplars([torch.where(mask, 0, image)])
    check_seed(seed)
    for name, cost in costs.items():
        check_not_negative(name, cost)
    for name, value in (("offsets", offsets), ("reach", reach)):
        if value < 1:
            raise ValueError(f"{name}={value} must be at least 1")
