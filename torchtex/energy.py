"""Energies: the protocols, their weighted sum, and the texture energy."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchtex.features import Feature, Pixels, as_windowed, is_linear
from torchtex.neighborhoods import Grid, falloff
from torchtex.quadratic import Quadratic, rowwise_sum, total


@runtime_checkable
class Energy(Protocol):
    """Any function of the image; the gradient comes for free."""

    def __call__(self, x: Float[Tensor, "c h w"]) -> Float[Tensor, ""]: ...


@runtime_checkable
class Bounded(Protocol):
    """Optional: a quadratic that touches the energy at x and lies above it everywhere."""

    def quadratic_bound(self, x: Float[Tensor, "c h w"]) -> Quadratic | None: ...


@dataclass(frozen=True)
class Objective:
    """Weighted sum of energies.

    Example:
        >>> Objective(((2.0, lambda x: x.sum()),))(torch.ones(1, 1, 1)).item()
        2.0
    """

    terms: tuple[tuple[float, Energy], ...]

    def __call__(self, x: Float[Tensor, "c h w"]) -> Float[Tensor, ""]:
        return sum((weight * energy(x) for weight, energy in self.terms), x.new_zeros(()))

    def quadratic_bound(self, x: Float[Tensor, "c h w"]) -> Quadratic | None:
        """Sum of the bounds of all terms; None when a term has none, or a negative weight."""
        bounds = []
        for weight, energy in self.terms:
            bound = energy.quadratic_bound(x) if isinstance(energy, Bounded) else None
            if bound is None or weight < 0:  # a negative bound would lie below
                return None
            bounds.append((weight, bound))
        return total(bounds)


@dataclass(frozen=True)
class Windows:
    """Feature neighborhoods of a texture: sqrt(fall-off) * window of psi(x), as vectors.

    Args:
        grid: the sites.
        feature: psi.
        guide: (g, h, w) fixed channels appended to psi(x), or None.
        most: windows held in memory at a time, about.
    """

    grid: Grid
    feature: Feature
    guide: Float[Tensor, "g h w"] | None = None
    most: int = 16384

    @property
    def bands(self) -> list[slice]:
        """Slices of site rows that bound memory by values, not by windows alone."""
        return self.grid.bands(max(64, self.most * 64 // self.grid.size**2))

    def channels(self, x: Float[Tensor, "c h w"]) -> Float[Tensor, "k h w"]:
        """psi(x); at a periodic border psi sees the other side."""
        if not self.grid.periodic or isinstance(self.feature, Pixels):
            return self.feature(x)
        h, w = x.shape[1:]
        margin = min(32, h, w)
        wide = F.pad(x[None], (margin,) * 4, mode="circular")[0]
        return self.feature(wide)[:, margin : margin + h, margin : margin + w]

    def vectors(
        self, channels: Float[Tensor, "k h w"], band: slice, *, guided: bool = True
    ) -> Float[Tensor, "n d"]:
        """Neighborhood vectors of the site rows of `band`."""
        if guided and self.guide is not None:
            channels = torch.cat([channels, self.guide])
        return embed(_Gather.apply(channels, self.grid, band), self.grid.size, self.feature)


def embed(patches: Float[Tensor, "n e"], size: int, feature: Feature) -> Float[Tensor, "n d"]:
    """Weights windows by sqrt(fall-off), then applies the in-window stage of the feature."""
    weights = falloff(size).sqrt().to(patches)
    windowed = as_windowed(feature)
    if windowed is None:
        k = patches.shape[1] // size**2
        return patches * weights.flatten().repeat_interleave(k)
    windows = patches.view(len(patches), size, size, -1) * weights[:, :, None]
    return windowed.window(windows).reshape(len(patches), -1)


@dataclass(frozen=True)
class TextureEnergy:
    """sum over sites p of (|psi(x)_p - z_p|^2 + eps^2)^(r / 2), with the fall-off in the norm.

    Bounded when psi is linear: t -> (t + eps^2)^(r/2) is concave for r <= 2, so its tangent at
    the present distances is a quadratic in x that touches E there and lies above it (iteratively
    reweighted least squares).

    Args:
        windows: neighborhoods of the texture.
        targets: band -> (n, d), the matched exemplar neighborhoods z_p of those site rows.
        r: robust exponent in (0, 2]; 2 is least squares.
        eps: smooths the weights at zero; in units of the norm.

    Source: Kwatra et al. 2005, eq. 1 and section 3.1.
    """

    windows: Windows
    targets: Callable[[slice], Tensor]
    r: float = 0.8
    eps: float = 0.1

    def distances(self, x: Float[Tensor, "c h w"]) -> Float[Tensor, "n"]:
        """Squared distance of each neighborhood to its match."""
        channels = self.windows.channels(x)
        return torch.cat(
            [
                (self.windows.vectors(channels, band) - self.targets(band)).square().sum(1)
                for band in self.windows.bands
            ]
        )

    def __call__(self, x: Float[Tensor, "c h w"]) -> Float[Tensor, ""]:
        return self.of_distances(self.distances(x))

    def of_distances(self, squared: Float[Tensor, "n"]) -> Float[Tensor, ""]:
        """The energy, when the squared distances are known."""
        return rowwise_sum((squared + self.eps**2) ** (self.r / 2))

    def site_weights(self, squared: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Slope of the energy in the squared distance: the IRLS weights."""
        return self.r / 2 * (squared + self.eps**2) ** (self.r / 2 - 1)

    def quadratic_bound(self, x: Float[Tensor, "c h w"]) -> Quadratic | None:
        """The tangent quadratic at x; None when psi is not linear."""
        feature = self.windows.feature
        if not is_linear(feature):
            return None
        squared = self.distances(x)
        sites = self.site_weights(squared)
        if as_windowed(feature) is not None:
            part = self._window_part(x, sites)
        elif isinstance(feature, Pixels):
            part = self._pixel_part(x, sites)
        else:
            part = self._image_part(x, sites)
        return replace(part, constant=self.of_distances(squared) - part(x))

    def _site_slices(self) -> list[tuple[slice, slice]]:
        nx = self.windows.grid.shape[1]
        return [(band, slice(band.start * nx, band.stop * nx)) for band in self.windows.bands]

    def _coverage(self, x: Tensor, sites: Tensor) -> Tensor:
        """(1, h, w): sum of site weight times fall-off over the windows that hold a pixel."""
        grid = self.windows.grid
        profile = falloff(grid.size).to(x).flatten()
        cover = grid.zeros(x, 1)
        for band, some in self._site_slices():
            grid.scatter(sites[some, None] * profile, band, out=cover)
        return cover.contiguous()

    def _pulled(self, x: Tensor, sites: Tensor, k: int) -> Tensor:
        """(k, h, w): sum of site weight times fall-off times matched channels over the windows."""
        grid = self.windows.grid
        root = falloff(grid.size).sqrt().to(x).flatten()
        pulled = grid.zeros(x, k)
        for band, some in self._site_slices():
            target = self.targets(band).view(-1, grid.size**2, self._width(k))[:, :, :k]
            weighted = target * (sites[some, None, None] * root[:, None])
            grid.scatter(weighted.flatten(1), band, out=pulled)
        return pulled.contiguous()

    def _pixel_part(self, x: Tensor, sites: Tensor) -> Quadratic:
        """Closed form: every pixel is a weighted mean of the matched pixels."""
        weight = self._coverage(x, sites)
        b = self._pulled(x, sites, len(x))
        return Quadratic(lambda y: weight * y, b, x.new_zeros(()), weight.expand_as(x))

    def _image_part(self, x: Tensor, sites: Tensor) -> Quadratic:
        """A = psi^T diag(coverage) psi: windows need not be gathered to apply it."""
        weight = self._coverage(x, sites)

        def adjoint(y: Tensor, weigh: Callable[[Tensor], Tensor]) -> Tensor:
            y = y.detach().requires_grad_()
            with torch.enable_grad():
                channels = self.windows.channels(y)
            return torch.autograd.grad(channels, y, weigh(channels.detach()))[0]

        return Quadratic(
            lambda y: adjoint(y, lambda channels: weight * channels),
            adjoint(x, lambda channels: self._pulled(x, sites, len(channels))),
            x.new_zeros(()),
            weight.expand_as(x),
            self._response(x),
        )

    def _width(self, k: int) -> int:
        return k if self.windows.guide is None else k + self.windows.guide.shape[0]

    def _window_part(self, x: Tensor, sites: Tensor) -> Quadratic:
        """A and b through the windows, by autograd: the feature gives only its forward map."""

        def pull(y: Tensor, use: Callable[[Tensor, slice, slice], Tensor]) -> Tensor:
            y = y.detach().requires_grad_()
            with torch.enable_grad():
                channels = self.windows.channels(y)
                out = torch.zeros_like(channels)
                for band, some in self._site_slices():
                    leaf = channels.detach().requires_grad_()
                    value = use(self.windows.vectors(leaf, band, guided=False), band, some)
                    out += torch.autograd.grad(value, leaf)[0]
                return torch.autograd.grad(channels, y, out)[0]

        def squares(vectors: Tensor, band: slice, some: slice) -> Tensor:
            return (sites[some, None] * vectors.square()).sum() / 2

        def products(vectors: Tensor, band: slice, some: slice) -> Tensor:
            target = self.targets(band)
            if self.windows.guide is not None:
                size = self.windows.grid.size**2
                k = vectors.shape[1] // size
                target = target.view(-1, size, self._width(k))[:, :, :k].flatten(1)
            return (sites[some, None] * vectors * target).sum()

        return Quadratic(
            lambda y: pull(y, squares),
            pull(x, products),
            x.new_zeros(()),
            self._coverage(x, sites).expand_as(x),
            self._response(x),
        )

    def _response(self, x: Tensor) -> Tensor:
        """Frequency response of psi^T psi, per channel, from an impulse in the middle."""
        c, h, w = x.shape
        rows = []
        for channel in range(c):
            impulse = torch.zeros_like(x)
            impulse[channel, h // 2, w // 2] = 1
            impulse.requires_grad_()
            with torch.enable_grad():
                norm = self.windows.channels(impulse).square().sum() / 2
                echo = torch.autograd.grad(norm, impulse)[0][channel]
            rows.append(torch.fft.rfft2(echo).abs())
        return torch.stack(rows)


class _Gather(torch.autograd.Function):
    """Gather with scatter as its derivative: autograd's own would add up element by element."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, grid: Grid, band: slice) -> Tensor:
        ctx.grid, ctx.band = grid, band
        return grid.gather(image, band)

    @staticmethod
    def backward(ctx: Any, patches: Tensor) -> tuple[Tensor, None, None]:
        return _Scatter.apply(patches, ctx.grid, ctx.band), None, None


class _Scatter(torch.autograd.Function):
    """The adjoint of `_Gather`, so that second derivatives work too."""

    @staticmethod
    def forward(ctx: Any, patches: Tensor, grid: Grid, band: slice) -> Tensor:
        ctx.grid, ctx.band = grid, band
        return grid.scatter(patches, band)

    @staticmethod
    def backward(ctx: Any, image: Tensor) -> tuple[Tensor, None, None]:
        return _Gather.apply(image, ctx.grid, ctx.band), None, None
