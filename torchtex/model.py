"""The texture model: exemplars made ready for one grid of windows, and the M-step."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.controls import Guide, SoftConstraint
from torchtex.energy import Energy, TextureEnergy, Windows, embed
from torchtex.features import Feature, Pixels
from torchtex.label_spaces import LabelSpace, Strips, label_space, strips
from torchtex.matching import (
    Clustered,
    Exact,
    Index,
    Matcher,
    complete_search,
    principal_axes,
)
from torchtex.neighborhoods import Grid


@dataclass(frozen=True)
class Search:
    """How the M-step looks for labels.

    Candidates of a site are the k nearest keys and, with `coherence`, the labels of its
    neighbors shifted by the distance between the sites; all are compared by their full distance.

    Args:
        matcher: the index over keys.
        dimensions: principal axes the keys are reduced to before they enter the index; None
            keeps them whole.
        candidates: k.
        coherence: add the shifted labels of the four neighboring sites.

    Source: coherence candidates after Ashikhmin 2001 and Tong et al. 2002.
    """

    matcher: Matcher
    dimensions: int | None = None
    candidates: int = 1
    coherence: bool = False

    def __post_init__(self) -> None:
        if self.candidates < 1:
            raise ValueError(f"candidates={self.candidates} must be at least 1")
        if self.dimensions is not None and self.dimensions < 1:
            raise ValueError(f"dimensions={self.dimensions} must be at least 1, or None")


def exact_search() -> Search:
    """The nearest key, always."""
    return Search(Exact())


def fast_search() -> Search:
    """Principal axes, clusters and coherent candidates."""
    return Search(Clustered(), dimensions=48, candidates=4, coherence=True)


@dataclass(frozen=True)
class TextureModel:
    """Exemplars made ready for one grid of windows; built by `texture_model`.

    `match` is the M-step, `energy` the texture energy of given labels.
    """

    windows: Windows
    space: LabelSpace
    pixels: "Strips"
    strips: "Strips"
    search: Search
    axes: Float[Tensor, "d q"] | None
    keys: Float[Tensor, "m q"]
    index: Index
    completeness: float
    r: float
    eps: float

    @property
    def grid(self) -> Grid:
        return self.windows.grid

    def targets(self, labels: Int[Tensor, "n"]) -> Float[Tensor, "n d"]:
        """Exemplar neighborhoods of labels, in feature space."""
        return embed(self.strips.patches(labels), self.grid.size, self.windows.feature)

    def energy(self, labels: Int[Tensor, "n"]) -> TextureEnergy:
        """The texture energy with the matches fixed."""
        nx = self.grid.shape[1]

        def band_targets(band: slice) -> Tensor:
            return self.targets(labels[band.start * nx : band.stop * nx])

        return TextureEnergy(self.windows, band_targets, self.r, self.eps)

    @torch.no_grad()
    def match(
        self,
        x: Float[Tensor, "c h w"],
        labels: Int[Tensor, "n"] | None = None,
        controls: Sequence[tuple[float, Energy]] = (),
    ) -> Int[Tensor, "n"]:
        """The M-step: the label of each site, given pixels.

        An old label stays unless the new one is strictly nearer, so an approximate index can
        slow convergence but never raise the energy (with completeness=0).

        Source: Kwatra et al. 2005, Algorithm 1, and Algorithm 2 for soft constraints.
        """
        soft = [(w, c) for w, c in controls if isinstance(c, SoftConstraint) and w > 0]
        pull = _merge(soft, x) if soft else None
        channels = self.windows.channels(x)
        if self.completeness > 0 and pull is None:
            return self._complete(channels)
        blended = None
        if pull is not None:
            confidence, target = pull
            blended = self.windows.channels((x + confidence * target) / (1 + confidence))
        coherent = None
        if labels is not None and self.search.coherence:
            coherent = self._coherent(labels)
        nx = self.grid.shape[1]
        found = []
        for band in self.windows.bands:
            some = slice(band.start * nx, band.stop * nx)
            queries = self.windows.vectors(channels, band)
            candidates = self._candidates(queries)
            if blended is not None:
                more = self._candidates(self.windows.vectors(blended, band))
                candidates = torch.cat([candidates, more], 1)
            if labels is not None:
                if coherent is not None:
                    candidates = torch.cat([coherent[some], candidates], 1)
                candidates = torch.cat([labels[some, None], candidates], 1)
            found.append(self._nearest(queries, candidates, pull, band))
        return torch.cat(found)

    def reduced(self, vectors: Float[Tensor, "n d"]) -> Float[Tensor, "n q"]:
        """Vectors on the principal axes, if the search uses them."""
        return vectors if self.axes is None else vectors @ self.axes

    def _candidates(self, queries: Tensor) -> Tensor:
        return self.index.search(self.reduced(queries), self.search.candidates)[1]

    def _complete(self, channels: Tensor) -> Tensor:
        queries = torch.cat(
            [self.reduced(self.windows.vectors(channels, band)) for band in self.windows.bands]
        )
        return complete_search(queries, self.keys, 1, alpha=1 / self.completeness)[1][:, 0]

    def _coherent(self, labels: Tensor) -> Tensor:
        """The labels of the four neighbors, shifted; its own where that leaves the exemplar."""
        ny, nx = self.grid.shape
        sites = self.grid.sites.to(labels.device)
        place = torch.arange(ny * nx, device=labels.device).view(ny, nx)
        out = []
        for dim, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            near = place.roll(step, dim).flatten()
            shift = sites - sites[near]
            if self.grid.periodic:
                for axis, extent in ((0, self.grid.height), (1, self.grid.width)):
                    half = extent // 2
                    shift[:, axis] = (shift[:, axis] + half) % extent - half
            moved = self.space.positions[labels[near]].clone()
            moved[:, 1:] += shift
            label = self.space.at(moved)
            out.append(torch.where(label < 0, labels, label))
        return torch.stack(out, 1)

    def _nearest(
        self,
        queries: Tensor,
        candidates: Tensor,
        pull: tuple[Tensor, Tensor] | None,
        band: slice,
    ) -> Tensor:
        if candidates.shape[1] == 1:
            return candidates[:, 0]
        if self.axes is not None and pull is None and candidates.shape[1] > 4:
            candidates = self._shortlist(queries, candidates, 3)
        best = labels = None
        # one column at a time, in order: an earlier candidate wins a tie
        for label in candidates.unbind(1):
            cost = (queries - self.targets(label)).square().sum(1)
            if pull is not None:
                cost = cost + self._pull_cost(label, pull, band)
            if best is None or labels is None:
                best, labels = cost, label
            else:
                nearer = cost < best
                best = torch.where(nearer, cost, best)
                labels = torch.where(nearer, label, labels)
        assert labels is not None
        return labels

    def _shortlist(self, queries: Tensor, candidates: Tensor, count: int) -> Tensor:
        """The first candidate and the `count` nearest others, by reduced distance."""
        short = self.reduced(queries)
        others = candidates[:, 1:]
        near = (self.keys[others] - short[:, None]).square().sum(2)
        pick = near.topk(count, dim=1, largest=False)[1]
        return torch.cat([candidates[:, :1], others.gather(1, pick)], 1)

    def _pull_cost(self, labels: Tensor, pull: tuple[Tensor, Tensor], band: slice) -> Tensor:
        confidence, target = pull
        size, c = self.grid.size, len(target)
        wished = self.grid.gather(target, band)
        held = self.grid.gather(confidence, band).repeat_interleave(c, 1)
        gap = embed((self.pixels.patches(labels) - wished) * held.sqrt(), size, Pixels())
        return gap.square().sum(1)


def _merge(
    soft: Sequence[tuple[float, SoftConstraint]], x: Tensor
) -> tuple[Float[Tensor, "1 h w"], Float[Tensor, "c h w"]]:
    """Several soft constraints as one: their weights add up, their targets are averaged."""
    held = sum((w * c.confidence.to(x) for w, c in soft), x.new_zeros(x.shape[1:]))
    target = sum((w * c.confidence.to(x) * c.target.to(x) for w, c in soft), torch.zeros_like(x))
    return held[None], target / held.clamp(min=torch.finfo(x.dtype).tiny)


def texture_model(
    exemplars: Sequence[Float[Tensor, "c _ _"]],
    grid: Grid,
    *,
    feature: Feature | None = None,
    search: Search | None = None,
    r: float = 0.8,
    completeness: float = 0.0,
    masks: Sequence[Bool[Tensor, "_ _"] | None] | None = None,
    guides: Sequence[Guide] = (),
    generator: torch.Generator | None = None,
) -> TextureModel:
    """Makes exemplars ready for one grid: label space, keys, index.

    Args:
        exemplars: images of the same channels; all their neighborhoods are candidates.
        grid: windows of the texture.
        feature: psi; pixels unless given.
        search: how labels are looked for; `fast_search()` unless given.
        r: robust exponent, in (0, 2].
        completeness: 0 for the nearest key; larger values let unused keys win (see
            `matching.complete_search`, alpha = 1 / completeness).
        masks: True where an exemplar may be used.
        guides: fixed channels, already at this grid's size.
        generator: for the principal axes.

    Raises:
        ValueError: no exemplar holds a whole unmasked window, or r or completeness out of range.
    """
    if not 0 < r <= 2:
        raise ValueError(f"r={r} must lie in (0, 2]")
    if not completeness >= 0:
        raise ValueError(f"completeness={completeness} must be at least 0")
    feature = Pixels() if feature is None else feature
    search = fast_search() if search is None else search
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    shapes = [(z.shape[1], z.shape[2]) for z in exemplars]
    space = label_space(shapes, grid.size, masks, device=exemplars[0].device)
    if not len(space):
        raise ValueError(
            f"exemplar: no whole unmasked window of size={grid.size} fits; "
            "choose smaller windows, a larger exemplar or a wider mask"
        )
    channels = [feature(z) for z in exemplars]
    guide = None
    if guides:
        guide = torch.cat([g.weight**0.5 * g.texture for g in guides])
        channels = [
            torch.cat([z, *(g.weight**0.5 * g.exemplars[number] for g in guides)])
            for number, z in enumerate(channels)
        ]
    windows = Windows(grid, feature, guide)
    pixel_strips = strips(exemplars, space, grid.size)
    feature_strips = strips(channels, space, grid.size)

    def keys_of(labels: Tensor) -> Tensor:
        return embed(feature_strips.patches(labels), grid.size, feature)

    device = exemplars[0].device
    d = feature_strips.table.shape[1] * grid.size
    axes = None
    if search.dimensions is not None and search.dimensions < d:
        pick = torch.randperm(len(space), generator=generator)[:1500].to(device)
        axes = principal_axes(keys_of(pick), search.dimensions, generator)
    every = torch.arange(len(space), device=device)
    keys_at_once = max(64, 2**22 // d)
    parts = [
        keys_of(part) if axes is None else keys_of(part) @ axes
        for part in every.split(keys_at_once)
    ]
    keys = torch.cat(parts)
    eps = 0.02 * d**0.5
    return TextureModel(
        windows, space, pixel_strips, feature_strips, search, axes, keys,
        search.matcher.fit(keys), completeness, r, eps,
    )  # fmt: skip
