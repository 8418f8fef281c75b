"""Designs: from one small texture, or several, to as many large ones as wanted.

The exemplars may first be deformed as a whole. Then their layers are deformed, several times, each
time otherwise, and the textures that this gives are one set of exemplars, from which a large one
is made by graph cut or by the EM solver with wavelets. Or layers are laid over all of the large
texture at once, which is quicker and shows more of them.

Source: Shen et al. 2006, Completion-based texture design, section 3.1; Shen et al. 2010, Texture
design by energy optimization, section 3.1 and figure 2.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context

import torch

from torchtex.inputs import Exemplars, check_seed, usable_exemplars
from torchtex.layers.deform import Spread
from torchtex.layers.segment import Segmentation
from torchtex.recipes.carried import itself
from torchtex.recipes.design_parts import (
    ENLARGE,
    Enlarge,
    Layering,
    bases_of,
    closed,
    deformed,
    enlarged,
    finished,
    layers_of,
    taste_of,
)
from torchtex.recipes.layered import part_seed
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.shares import share


def design(
    exemplars: Exemplars,
    size: tuple[int, int],
    *,
    layering: Layering | None = None,
    segmentations: Sequence[Segmentation] | None = None,
    spread: Spread | None = None,
    textures: int = 3,
    enlarge: Enlarge = "graphcut",
    cyclic_overlap: int | None = None,
    poisson: bool = False,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> Montage:
    """One new texture out of deformed layers of the exemplars.

    Args:
        exemplars: one image, or several, which are dealt to the small textures. What fits best
            is taken from those, so of unlike ones little may be seen; "layers" mixes more of them.
        size: (height, width) of the texture.
        layering: how layers are found, deformed and put together.
        segmentations: the layers of each exemplar, where they are known.
        spread: whole exemplars are deformed first, otherwise each time; None: they are not.
        textures: how many deformed textures the large one is made from.
        enlarge: "graphcut" copies patches of them, "wavelet" lowers the texture energy of windows
            compared by wavelets, "layers" lays layers over all of the large texture.
        cyclic_overlap: make the texture tile, by seams in an overlap of so many pixels; None for
            one that does not.
        poisson: even out levels along seams; `apply` does not do that.
        seed: same seed, same bits; another one gives another design.
        on_step: called after each step; raise from it to cancel.

    Returns:
        A montage of positions in the exemplars. `apply` equals the texture unless `poisson` or
        "wavelet" made pixels anew. Its settings hold the `plan` of the one texture, or the
        `plans` of all; the same, or edited ones, may be given as those of `layering`.

    Raises:
        ValueError: an option out of range, one layer only, or a layer that vanished.
        ImportError: without the extra `design` or a min-cut solver.

    Example:
        >>> from torchtex import data
        >>> made = design(data.load("tissue")[:, :64, :64], (80, 72), textures=1, seed=3)
        >>> made.texture.shape
        torch.Size([3, 80, 72])
    """
    began = time.perf_counter()
    zs, _ = usable_exemplars(exemplars)
    layering = Layering() if layering is None else layering
    _check(textures, enlarge, cyclic_overlap, size, layering, seed)
    made = layers_of(zs, layering) if segmentations is None else list(segmentations)
    extra = 0 if cyclic_overlap is None else cyclic_overlap
    extent = (size[0] + extra, size[1] + extra)
    taste = taste_of(made, layering.variety, seed)
    part = 1 / (textures + 3)
    if enlarge == "layers":
        plan = layering.plans[0] if layering.plans else None
        bases = bases_of(zs, layering, spread, seed)
        tell = share(on_step, 0.0, 1 - 2 * part)
        whole = deformed(zs, made, bases, extent, layering, seed, tell, plan=plan)
        plans = [whole.settings["plan"]]
    else:
        bases, parts = [], []
        generator = torch.Generator().manual_seed(seed)
        dealt = torch.randperm(len(zs), generator=generator).tolist()
        for n in range(textures):
            own = part_seed(seed, n)
            mine = bases_of(zs, layering, spread, own, dealt[n % len(zs)])
            tell = share(on_step, n * part, part)
            plan = layering.plans[n] if layering.plans else None
            parts.append(deformed(zs, made, mine, None, layering, own, tell, plan=plan))
            bases += mine if spread is not None else []
        bases = bases or [itself(zs, n) for n in range(len(zs))]
        plans = [one.settings["plan"] for one in parts]
    finish = partial(finished, zs=zs, bases=bases, layering=layering, poisson=poisson,
                     taste=taste, seed=seed)  # fmt: skip
    if enlarge == "wavelet":  # its pixels are new, and have no seams
        parts = [finish(one) for one in parts]
        whole = enlarged(
            zs, parts, extent, enlarge, seed, share(on_step, textures * part, 2 * part)
        )
        whole = closed(whole, zs, extra, solved=True) if extra else whole
    else:
        if enlarge == "graphcut":
            tell = share(on_step, textures * part, part)
            whole = enlarged(zs, parts, extent, enlarge, seed, tell, mending=layering.mending)
        whole = finish(whole, overlap=extra, on_step=share(on_step, 1 - 2 * part, 2 * part))
    settings = {
        "recipe": "design", "size": list(size), "layering": repr(replace(layering, plans=())),
        "spread": repr(spread), "textures": textures, "enlarge": enlarge,
        "cyclic_overlap": cyclic_overlap, "poisson": poisson,
        "layers": [s.count for s in made],
        **({"plan": plans[0]} if len(plans) == 1 else {"plans": plans}),
    }  # fmt: skip
    return replace(whole, seconds=time.perf_counter() - began, seed=seed, settings=settings)


def designs(
    exemplars: Exemplars,
    size: tuple[int, int],
    count: int,
    *,
    layering: Layering | None = None,
    segmentations: Sequence[Segmentation] | None = None,
    spread: Spread | None = None,
    textures: int = 3,
    enlarge: Enlarge = "graphcut",
    cyclic_overlap: int | None = None,
    poisson: bool = False,
    seed: int = 0,
    workers: int = 2,
    on_step: Callable[[Stage], None] | None = None,
) -> list[Montage]:
    """Several designs, of the seeds seed, seed + 1, ...: what `design` makes of each.

    Args:
        count: how many.
        workers: processes that share the work; 1 for none but this one. Pixels do not depend on
            it. Scripts that use more must have an `if __name__ == "__main__":`.
        on_step: called after each design, or with one worker after each step.
        exemplars, size, layering, segmentations, spread, textures, enlarge, cyclic_overlap,
            poisson, seed: of `design`.

    Raises:
        ValueError: as `design`.

    Example:
        >>> z = torch.rand(1, 40, 40, generator=torch.Generator().manual_seed(0))
        >>> z[:, 8:20, 8:24] /= 3
        >>> len(designs(z, (48, 48), 2, layering=Layering(2), textures=1, workers=1))
        2
    """
    if count < 1 or workers < 1:
        raise ValueError(f"count={count} and workers={workers} must be at least 1")
    zs, _ = usable_exemplars(exemplars)
    layering = Layering() if layering is None else layering
    _check(textures, enlarge, cyclic_overlap, size, layering, seed)
    check_seed(seed + count - 1)
    made = layers_of(zs, layering) if segmentations is None else list(segmentations)
    jobs = [
        partial(
            design, zs, size, layering=layering, segmentations=made, spread=spread,
            textures=textures, enlarge=enlarge, cyclic_overlap=cyclic_overlap, poisson=poisson,
            seed=seed + number,
        )
        for number in range(count)
    ]  # fmt: skip
    if workers == 1 or count == 1:
        return [job(on_step=share(on_step, n / count, 1 / count)) for n, job in enumerate(jobs)]
    found = []
    with ProcessPoolExecutor(min(workers, count), get_context("spawn")) as pool:
        waiting = [pool.submit(_alone, job) for job in jobs]
        try:
            for number, future in enumerate(waiting):
                found.append(future.result())
                if on_step is not None:
                    texture = found[-1].texture
                    on_step(Stage((number + 1) / count, "designs", texture))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return found


def _alone(job: Callable[[], Montage]) -> Montage:
    """In a process of its own, with one thread, since there are others."""
    torch.set_num_threads(1)
    return job()


def _check(
    textures: int, enlarge: str, overlap: int | None, size: tuple[int, int], layering: Layering,
    seed: int,
) -> None:  # fmt: skip
    check_seed(seed)
    if not 1 <= textures <= 100:
        raise ValueError(f"textures={textures} must lie in 1..100")
    if enlarge not in ENLARGE:
        raise ValueError(f"enlarge={enlarge!r} is unknown; choose {', '.join(ENLARGE)}")
    if overlap is not None and not 2 <= overlap <= min(size):
        raise ValueError(
            f"cyclic_overlap={overlap} must lie in 2..{min(size)}, the shorter side of size"
        )
    wanted = 1 if enlarge == "layers" else textures
    if layering.plans and len(layering.plans) != wanted:
        how = (
            "enlarge=layers needs one" if enlarge == "layers" else f"textures={textures}; give all"
        )
        raise ValueError(f"plan: {len(layering.plans)} given and {how}")
