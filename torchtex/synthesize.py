"""Coarse to fine: the whole synthesis, and its result."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.controls import Guide, Scaled, SoftConstraint
from torchtex.em import HalfStep, em
from torchtex.energy import Energy, Objective
from torchtex.estep import Auto, ClosedForm, EStep
from torchtex.features import Feature, Pixels
from torchtex.image import resize
from torchtex.model import LabelSpace, Search, TextureModel, fast_search, label_space, strips, texture_model
from torchtex.neighborhoods import Grid, falloff


@dataclass(frozen=True)
class Level:
    """One entry of a schedule: image scale, window size, and EM steps.

    `stride` is a quarter of the window unless given.
    """

    scale: float
    size: int
    steps: int
    stride: int | None = None


def default_schedule(steps: int | None = None) -> tuple[Level, ...]:
    """1/4 with 8; 1/2 with 16, 8; full with 32, 16, 8 (Kwatra et al. 2005, section 3.2)."""
    plan = ((0.25, 8, 8), (0.5, 16, 4), (0.5, 8, 4), (1.0, 32, 2), (1.0, 16, 2), (1.0, 8, 3))
    return tuple(Level(scale, size, steps or own) for scale, size, own in plan)


class Start(Protocol):
    """First pixels of the coarsest level."""

    def __call__(
        self, exemplars: Sequence[Tensor], masks: Sequence[Tensor | None],
        height: int, width: int, generator: torch.Generator,
    ) -> Float[Tensor, "c h w"]: ...  # fmt: skip


@dataclass(frozen=True)
class Blocks:
    """Random blocks of the coarse exemplar side by side, without averaging."""

    fraction: float = 0.5

    def __call__(
        self, exemplars: Sequence[Tensor], masks: Sequence[Tensor | None],
        height: int, width: int, generator: torch.Generator,
    ) -> Float[Tensor, "c h w"]:  # fmt: skip
        shortest = min(min(z.shape[1:]) for z in exemplars)
        size = max(4, min(round(shortest * self.fraction), shortest))
        return _blocks(exemplars, masks, height, width, size, generator)


def _blocks(exemplars, masks, height, width, size, generator):
    space = label_space([(z.shape[1], z.shape[2]) for z in exemplars], size, masks)
    table = strips(exemplars, space, size)
    ny, nx = -(-height // size), -(-width // size)
    labels = torch.randint(len(space), (ny * nx,), generator=generator)
    c = exemplars[0].shape[0]
    blocks = table.patches(labels).view(ny, nx, size, size, c).permute(4, 0, 2, 1, 3)
    return blocks.reshape(c, ny * size, nx * size)[:, :height, :width].contiguous()


def carry(old: TextureModel, labels, new_grid: Grid, space: LabelSpace, factor: tuple[float, float]):
    """Labels of one grid as labels of a finer one."""
    oy = old.grid.rows; ox = old.grid.cols
    def nearest(new, olds, f, s_new, s_old):
        centre = (new + s_new / 2) / f - s_old / 2
        pick = (centre[:, None] - olds[None].double()).abs().argmin(1)
        return pick, centre - olds[pick]
    py, dy = nearest(new_grid.rows, oy, factor[0], new_grid.size, old.grid.size)
    px, dx = nearest(new_grid.cols, ox, factor[1], new_grid.size, old.grid.size)
    pos = old.space.positions[labels].view(len(oy), len(ox), 3)[py][:, px].double()
    row = pos[..., 1] + dy[:, None] + old.grid.size / 2
    col = pos[..., 2] + dx[None] + old.grid.size / 2
    which = pos[..., 0].long()
    limits = torch.tensor([[t.shape[0] - new_grid.size, t.shape[1] - new_grid.size] for t in space.tables])
    r = (row * factor[0] - new_grid.size / 2).round().long()
    c = (col * factor[1] - new_grid.size / 2).round().long()
    r = torch.minimum(r.clamp(min=0), limits[which][..., 0])
    c = torch.minimum(c.clamp(min=0), limits[which][..., 1])
    return space.at(torch.stack([which, r, c], -1).view(-1, 3))


def synthesize(exemplar, size, *, seed=0, feature=None, r=0.8, completeness=50.0, complete_scale=0.5, schedule=None, start=None,
               search=None, estep=None, carrying=True, periodic=False, log=None):
    exemplars = [exemplar]; masks=[None]
    g = torch.Generator().manual_seed(seed)
    H, W = size
    x = None; old = None
    estep = estep or Auto()
    schedule = schedule or default_schedule()
    for i, lev in enumerate(schedule):
        t0=time.time()
        h, w = round(H * lev.scale), round(W * lev.scale)
        zs = [resize(z, (round(z.shape[1]*lev.scale), round(z.shape[2]*lev.scale))) if lev.scale != 1 else z for z in exemplars]
        if min(min(z.shape[1:]) for z in zs) < lev.size: continue
        grid = Grid(h, w, lev.size, lev.stride or max(1, lev.size // 4), periodic)
        model = texture_model(zs, grid, feature=feature, search=search, r=r,
            completeness=completeness if lev.scale <= complete_scale else 0, generator=g)
        t1=time.time()
        labels = None
        if x is None:
            x = (start or Blocks())(zs, masks, h, w, g)
        elif x.shape[1:] != (h, w):
            if carrying:
                f = (h / x.shape[1], w / x.shape[2])
                s2 = min(2 * old.grid.size, min(min(z.shape[1:]) for z in zs))
                g2 = Grid(h, w, s2, s2 // 4, periodic)
                m2 = texture_model(zs, g2, feature=Pixels(), search=Search(NoIndex(), 4), r=r)
                lab = carry(old, labels_old, g2, m2.space, f)
                up = resize(x, (h, w))
                x = ClosedForm()(Objective(((1.0, m2.energy(lab)),)), up)
            else:
                x = resize(x, (h, w))
        fit = em(x, [model], [], estep, steps=lev.steps, labels=labels)
        x, labels_old, old = fit.texture, fit.labels[0], model
        if log is not None: log.append((lev, t1-t0, time.time()-t1, [round(e) for e in fit.energies], x))
    return x, labels_old, old


@dataclass(frozen=True)
class NoIndex:
    def fit(self, keys):
        return None
