"""Skeletal synthesis: only the coarse band is synthesised, details are copied along.

The exemplar is split into a coarse band and details. The band is synthesised, every pixel of the
new one remembers where it is from, the details come from there too, and the inverse transform
puts all together. With Haar a coarse pixel becomes a square of 2^levels pixels, copied whole.

What is copied is the band as well as its details: an average of windows under details of one
place is blurred, and shows the squares. So the texture is a montage, and its seams are moved to
where they show least before the details are added.

Source: Pan et al. 2009, Skeletal texture synthesis; the seams are ours, after Kwatra et al. 2003.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Int
from torch import Tensor

from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.features import Feature
from torchtex.image import resize
from torchtex.inputs import Exemplars, Masks, check_seed, usable_exemplars
from torchtex.label_spaces import LabelSpace, label_space
from torchtex.recipes.block_seams import STEPS, block_seams
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.skeleton_blocks import LEAST, BlockShape
from torchtex.recipes.torn_windows import mended
from torchtex.result import Progress, Result
from torchtex.schedule import Level, default_schedule, roomy
from torchtex.sources import copied, pixel_places
from torchtex.synthesize import synthesize

_LAST = (Level(1.0, 16, 2, complete=True), Level(1.0, 8, 1))
"""Levels of the coarse band at full scale; the first leaves no feature out."""


def skeleton(
    exemplars: Exemplars,
    size: tuple[int, int],
    *,
    levels: int = 1,
    wavelet: str = "haar",
    phases: int = 1,
    cut: Literal["mincut", "none"] = "mincut",
    mend: bool = True,
    solver: MinCut | None = None,
    feature: Feature | None = None,
    schedule: Sequence[Level] | None = None,
    boundary: Literal["free", "periodic"] = "free",
    masks: Masks = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """A texture whose coarse band is synthesised, and whose details are copied with it.

    A size that 2^levels does not divide is made larger and cropped; of an exemplar the rows and
    columns that fill no block are left out. The settings say how much.

    Args:
        exemplars: one image, or several with equal channels.
        size: (height, width) of the texture.
        levels: how often the images are halved; each makes the work about four times less.
        wavelet: what makes the coarse band. Without `mend`, "haar" copies pixels, and a longer one,
            such as "db2", copies coefficients: its filters reach into the next blocks, and blend
            across seams (see `bands.BandField`). The longer, the more they ring where details of
            unlike pieces meet; db4 and longer ones leave speckles.
        phases: shifts of the exemplar, along each axis, that give a coarse exemplar each; a power
            of 2, at most 2^levels.
        cut: "mincut" moves seams between pieces to where they show least, with `mend` at
            every finer level again; "none" leaves them.
        mend: match and average windows where pieces meet, at every finer level; pixels elsewhere
            stay copies, whatever the wavelet.
        solver: of the cut; None for the first one that is installed.
        feature: what is compared in the coarse band; pixels unless given.
        schedule: of the coarse band, relative to it; the part of `default_schedule` that is as
            coarse unless given.
        boundary: "periodic" makes a texture that tiles; 2^levels must divide its size.
        masks: True where an exemplar may be used; one per exemplar.
        seed: same seed, same machine: same bits.
        on_step: called after each half-step and each move of seams; may raise to cancel.

    Raises:
        ValueError: an option out of range, or exemplars or a size that are too small.
        ImportError: no solver for the cut is installed.

    Source: Pan et al. 2009, sections 3 and 4.

    Example:
        >>> result = skeleton(torch.rand(3, 40, 40), (48, 56), cut="none")
        >>> result.texture.shape
        torch.Size([3, 48, 56])
    """
    began = time.perf_counter()
    zs, keep = usable_exemplars(exemplars, masks)
    check_seed(seed)
    shape = BlockShape(size, levels, wavelet, phases, boundary)
    shape.check(zs)
    if cut not in ("mincut", "none"):
        raise ValueError(f"cut={cut!r} is unknown; choose mincut or none")
    if cut == "mincut":
        solver = default_solver() if solver is None else solver
    elif solver is not None:
        raise ValueError("solver belongs to cut=mincut; leave it out")
    space = shape.places(zs, keep)
    coarse = [shape.coarse(z) for z in zs]
    pictures, usable, corners = shape.exemplars(coarse, space)
    plan = _plan(pictures, usable, shape) if schedule is None else tuple(schedule)
    report = _reporter(on_step, size, 0.8 if cut == "mincut" or mend else 1.0)
    made = synthesize(
        pictures,
        shape.blocks,
        masks=usable,
        feature=feature,
        schedule=plan,
        boundary=boundary,
        seed=seed,
        on_step=report,
    )
    places = shape.origins(made.source_map, corners)
    moved = 0
    if cut == "mincut":
        watch = _seam_reporter(on_step, made.texture, size)
        after = _moved(places, shape, zs, space, solver, watch)
        moved, places = int((after != places).any(-1).sum()), after
    margin = shape.margin * shape.side
    if mend:
        places, last = _descended(places, shape, zs, keep, solver)
        copies = last.copies(places, zs, margin)
        field = mended(copies, zs, keep, periodic=boundary == "periodic")
    else:
        field = shape.field(places, zs, margin)
    settings = {
        "recipe": "skeleton",
        "size": list(size),
        "made": [n * shape.side for n in shape.blocks],
        "levels": levels,
        "wavelet": wavelet,
        "phases": phases,
        "cut": cut,
        "moved": moved,
        "mend": mend,
        "unused": [[n % (shape.side // phases) for n in z.shape[1:]] for z in zs],
        "coarse": made.settings,
    }
    texture = field.apply(zs)
    texture = texture if mend or wavelet == "haar" else texture.clamp(0, 1)
    if mend and on_step is not None:
        on_step(Stage(1.0, "mending", texture))
    pieces = _pieces(field.source_map(), boundary)
    seconds = time.perf_counter() - began
    return Montage(texture, field, pieces, seconds, seed, settings)


def refine(
    made: Montage,
    exemplars: Exemplars,
    *,
    steps: int = 1,
    window: int = 8,
    boundary: Literal["free", "periodic"] = "free",
    masks: Masks = None,
    seed: int = 0,
    on_step: Callable[[Progress], None] | None = None,
) -> Result:
    """A few iterations of the optimisation at full size, from a montage: seams are averaged away.

    Args:
        made: of `skeleton`, or of another recipe.
        exemplars, boundary, masks: those that it was made with.
        steps: iterations.
        window: side of the windows.
        seed, on_step: as in `synthesize`.

    Raises:
        ValueError: as `synthesize`.

    Source: Pan et al. 2009, fig. 1, process E, "which is optional".

    Example:
        >>> exemplar = torch.rand(3, 40, 40)
        >>> refine(skeleton(exemplar, (48, 56), cut="none"), exemplar).texture.shape
        torch.Size([3, 48, 56])
    """
    h, w = made.texture.shape[1:]
    plan = (Level(1.0, window, steps),)
    done = synthesize(
        exemplars, (h, w), init=made.texture, schedule=plan, boundary=boundary, masks=masks,
        seed=seed, on_step=on_step,
    )  # fmt: skip
    settings = {**made.settings, "refined": dict(done.settings)}
    return replace(done, seconds=made.seconds + done.seconds, settings=settings)


def _plan(
    pictures: Sequence[Tensor], usable: Sequence[Tensor], shape: BlockShape
) -> tuple[Level, ...]:
    """The coarser levels of the default schedule, and those at full scale.

    Where few blocks fit into the exemplars, or into their masks, there are levels of our own.
    """
    most = min(*shape.blocks, max(min(picture.shape[1:]) for picture in pictures))
    plan = [
        replace(level, scale=level.scale * shape.side)
        for level in default_schedule()
        if level.scale * shape.side < 1
    ]
    if shape.levels > 1:
        plan = [Level(0.5, 8 if most >= 32 else 4, 6)]
    plan += _LAST
    shapes = [(picture.shape[1], picture.shape[2]) for picture in pictures]

    def fits(size: int) -> bool:
        return bool(len(label_space(shapes, size, usable)))

    picture = pictures[0].new_zeros(1, most, most)
    room = [level for level in roomy(plan, [picture]) if level.extent(most) >= level.size]
    room = [level for level in room if level.scale < 1 or fits(level.size)]
    if room and room[-1].scale == 1:
        return tuple(room)
    if not fits(LEAST):
        side = LEAST * shape.side
        raise ValueError(
            f"levels={shape.levels} is too many for these masks, which leave no {side}x{side} "
            "pixels whole; choose fewer levels or wider masks"
        )
    return (Level(1.0, LEAST, 8),)


def _moved(
    places: Int[Tensor, "y x 3"],
    shape: BlockShape,
    zs: Sequence[Tensor],
    space: LabelSpace,
    solver: MinCut | None,
    report: Callable[[int, float], None],
) -> Int[Tensor, "y x 3"]:
    """Places of blocks, the seams between them moved to where they show least."""
    seams = block_seams(zs, space, shape.side, shape.boundary == "periodic")
    return space.positions.to(places.device)[seams.moved(places, solver, report)]


def _descended(
    places: Int[Tensor, "y x 3"],
    shape: BlockShape,
    zs: Sequence[Tensor],
    keep: Sequence[Tensor | None],
    solver: MinCut | None,
) -> tuple[Int[Tensor, "y2 x2 3"], BlockShape]:
    """Places of blocks of two pixels a side, mended and cut again at every level on the way.

    Args:
        solver: of the cuts; None for none.
    """
    while shape.levels > 1:
        places = shape.split(places)
        phases = min(shape.phases, shape.side // 2)
        shape = replace(shape, levels=shape.levels - 1, phases=phases)
        space = shape.places(zs, keep)
        coarse = [shape.coarse(z) for z in zs]
        pictures, usable, corners = shape.exemplars(coarse, space)
        shapes = [(z.shape[1], z.shape[2]) for z in pictures]
        field = copied(shape.sources(places, corners), shapes)
        periodic = shape.boundary == "periodic"
        field = mended(field, pictures, usable, periodic=periodic)
        places = shape.origins(field.source_map(), corners)
        if solver is not None:  # blocks are smaller now, and seams need no longer be straight
            places = _moved(places, shape, zs, space, solver, lambda move, energy: None)
    return places, shape


def _pieces(source: Int[Tensor, "h w 3"], boundary: str) -> Int[Tensor, "h w"]:
    """Pixels that were moved together have one number."""
    which, row, col = source.unbind(-1)
    y, x = pixel_places(which.shape, source.device).unbind(-1)
    down, right = row - y, col - x
    if boundary == "periodic":
        down, right = down % which.shape[0], right % which.shape[1]
    down, right = down - down.min(), right - right.min()
    key = (which * (down.max() + 1) + down) * (right.max() + 1) + right
    return torch.unique(key, return_inverse=True)[1]


def _reporter(
    on_step: Callable[[Stage], None] | None, size: tuple[int, int], share: float
) -> Callable[[Progress], None] | None:
    if on_step is None:
        return None

    def report(progress: Progress) -> None:
        preview = resize(progress.texture, size).clamp(0, 1)
        on_step(Stage(share * progress.done, f"coarse {progress.note}", preview, progress.detail))

    return report


def _seam_reporter(
    on_step: Callable[[Stage], None] | None, coarse: Tensor, size: tuple[int, int]
) -> Callable[[int, float], None]:
    preview = None if on_step is None else resize(coarse, size).clamp(0, 1)

    def report(move: int, energy: float) -> None:
        if on_step is not None and preview is not None:
            done = 0.8 + 0.2 * (move + 1) / len(STEPS)
            on_step(Stage(done, "seams", preview, f"cost {energy:.4g}"))

    return report
