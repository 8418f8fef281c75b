"""Search for a patch, or part of one, among all positions of an exemplar.

`ssd` costs every position, by Fourier transforms; `qtp.Qtp` finds the best few of them, sooner.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex.quadratic import threads
from torchtex.templates import _known, known_exemplar, known_template

_TRANSFORMED = 2**22  # pixels of templates, enlarged to the exemplar, transformed at a time
_ROUNDING = 8 * torch.finfo(torch.float64).eps  # of a Fourier transform, with some room


def summed_area(x: Float[Tensor, "*batch h w"]) -> Float[Tensor, "*batch h+1 w+1"]:
    """Table whose entry (i, j) is the sum of the first i rows and j columns, in float64.

    Source: Crow 1984; its use for patch matching, Kwatra et al. 2003, section 3.2.

    Example:
        >>> summed_area(torch.ones(2, 3))[2, 3].item()
        6.0
    """
    table = x.new_zeros((*x.shape[:-2], x.shape[-2] + 1, x.shape[-1] + 1), dtype=torch.float64)
    with threads(1):
        table[..., 1:, 1:] = x.double().cumsum(-1).cumsum(-2)
    return table


def box_sums(
    table: Float[Tensor, "*batch h1 w1"], height: int, width: int
) -> Float[Tensor, "*batch rows cols"]:
    """Sums over every box of `height` x `width` pixels, from the table of `summed_area`.

    Raises:
        ValueError: a box is empty, or larger than the image.

    Example:
        >>> box_sums(summed_area(torch.ones(4, 5)), 2, 3).tolist()
        [[6.0, 6.0, 6.0], [6.0, 6.0, 6.0], [6.0, 6.0, 6.0]]
    """
    rows, cols = table.shape[-2] - 1, table.shape[-1] - 1
    if not (1 <= height <= rows and 1 <= width <= cols):
        raise ValueError(
            f"height={height}, width={width}: a box must fit in the image of {rows} x {cols} pixels"
        )
    lower = table[..., height:, width:] - table[..., height:, :-width]
    return lower - (table[..., :-height, width:] - table[..., :-height, :-width])


def ssd(
    exemplar: Float[Tensor, "c hz wz"],
    template: Float[Tensor, "c h w"],
    mask: Bool[Tensor, "h w"] | Float[Tensor, "h w"] | None = None,
    *,
    usable: Bool[Tensor, "hz wz"] | None = None,
) -> Float[Tensor, "rows cols"]:
    """Sum of squared differences of a template and the exemplar, at every position.

    C(q) = sum over p, channels of mask(p) (template(p) - exemplar(q + p))^2

    by Fourier transforms in float64; for many templates keep an `SsdSearch`. Values below the
    rounding error are 0, so that perfect matches are equal.

    Args:
        mask: True, or a weight, where the template counts; its other pixels may be anything.
        usable: False at exemplar pixels that no match may touch; positions whose template would
            cost infinity.

    Returns:
        (hz - h + 1, wz - w + 1) costs; entry (i, j) is for the template's first pixel at (i, j).

    Raises:
        ValueError: the template is larger than the exemplar, or the mask is empty.

    Source: Kwatra et al. 2003 (Graphcut textures), section 3.2.

    Example:
        >>> z = torch.rand(3, 16, 16)
        >>> costs = ssd(z, z[:, 4:9, 2:7])
        >>> divmod(int(costs.argmin()), costs.shape[1])
        (4, 2)
    """
    return ssd_search(exemplar, usable)(template[None], mask)[0]


@dataclass(frozen=True)
class SsdSearch:
    """An exemplar made ready for `ssd` with many templates; made by `ssd_search`.

    Its transforms are kept, so that a search costs those of the template and one back.

    Args:
        shape: (channels, rows, columns) of the exemplar.
        mean: (c,), taken off the exemplar and off templates, against cancellation.
        size: extent of the transforms.
        pixels, squares: transforms of the exemplar and of its squares, summed over channels.
        norms: Euclidean norms of the two; they scale the rounding error.
        barred: transform of the pixels that no match may touch, or None.
    """

    shape: tuple[int, int, int]
    mean: Tensor
    size: tuple[int, int]
    pixels: Tensor
    squares: Tensor
    norms: tuple[float, float]
    barred: Tensor | None

    def __call__(
        self,
        templates: Float[Tensor, "n c h w"],
        mask: Bool[Tensor, "*b h w"] | Float[Tensor, "*b h w"] | None = None,
    ) -> Float[Tensor, "n rows cols"]:
        """Costs as of `ssd` for each template; the mask is one for all, or (n, h, w).

        Example:
            >>> z = torch.rand(1, 12, 12)
            >>> ssd_search(z)(torch.stack([z[:, :4, :4], z[:, 5:9, 5:9]])).shape
            torch.Size([2, 9, 9])
        """
        t, m = known_template(templates, mask, self.shape)
        dtype = templates.dtype
        t = torch.where(m > 0, t.double() - self.mean[:, None, None], 0)
        m = m.expand(len(t), 1, *m.shape[2:]) if len(m) > 1 else m
        with threads(1):
            batch = max(1, _TRANSFORMED // (self.shape[0] * self.size[0] * self.size[1]))
            parts = [
                self._costs(a, m[i * batch : (i + 1) * batch] if len(m) > 1 else m).to(dtype)
                for i, a in enumerate(t.split(batch))
            ]
        return torch.cat(parts)

    def _costs(self, t: Tensor, m: Tensor) -> Tensor:
        _, hz, wz = self.shape
        rows, cols = hz - t.shape[2] + 1, wz - t.shape[3] + 1
        weighted = t * m
        own = (weighted * t).sum((1, 2, 3))
        seen = _forward(m, self.size)[:, 0]
        cross = (_forward(weighted, self.size).conj() * self.pixels).sum(1)
        costs = torch.fft.irfft2(seen.conj() * self.squares - 2 * cross, s=self.size)
        costs = costs[:, :rows, :cols] + own[:, None, None]
        # an FFT's error is relative to the norms of its inputs, not to the cost
        noise = self.norms[0] * weighted.square().sum((1, 2, 3)).sqrt()
        noise = noise + self.norms[1] * m.square().sum((1, 2, 3)).sqrt()
        costs = torch.where(costs < _ROUNDING * noise[:, None, None], 0, costs)
        if self.barred is None:
            return costs
        touched = _forward((m > 0).double(), self.size)[:, 0].conj() * self.barred
        count = torch.fft.irfft2(touched, s=self.size)[:, :rows, :cols]
        return torch.where(count > 0.5, torch.inf, costs)


def ssd_search(
    exemplar: Float[Tensor, "c hz wz"], usable: Bool[Tensor, "hz wz"] | None = None
) -> SsdSearch:
    """Fourier transforms of an exemplar, for repeated searches.

    Args:
        usable: False at pixels that no match may touch; they may be anything, NaN too.

    Raises:
        ValueError: the exemplar is no image, or no pixel of it is usable.

    Example:
        >>> z = torch.rand(3, 16, 16)
        >>> search = ssd_search(z)
        >>> search(z[None, :, 2:6, 3:7])[0, 2, 3].item()
        0.0
    """
    z, usable = known_exemplar(exemplar, usable)
    c, hz, wz = z.shape
    size = (_good(hz), _good(wz))
    with threads(1):
        count = hz * wz if usable is None else int(usable.sum())
        mean = z.double().sum((1, 2)) / count
        z = z.double() - mean[:, None, None]
        z = z if usable is None else torch.where(usable, z, 0)
        squares = z.square().sum(0)
        norms = float(squares.sum().sqrt()), float(squares.square().sum().sqrt())
        barred = None if usable is None else _forward((~usable).double(), size)
        return SsdSearch(
            (c, hz, wz), mean, size, _forward(z, size), _forward(squares, size), norms, barred
        )


def ssd_exhaustive(
    exemplar: Float[Tensor, "c hz wz"],
    template: Float[Tensor, "c h w"],
    mask: Bool[Tensor, "h w"] | Float[Tensor, "h w"] | None = None,
) -> Float[Tensor, "rows cols"]:
    """`ssd` by its definition: one template pixel after another against all positions.

    Slow, and exact; `ssd` is compared with it.

    Example:
        >>> ssd_exhaustive(torch.ones(1, 3, 3), torch.zeros(1, 2, 2)).tolist()
        [[4.0, 4.0], [4.0, 4.0]]
    """
    z, _ = known_exemplar(exemplar, None)
    t, m = known_template(template[None], mask, (z.shape[0], z.shape[1], z.shape[2]))
    t, m = t[0], m[0, 0]
    rows, cols = z.shape[1] - m.shape[0] + 1, z.shape[2] - m.shape[1] + 1
    costs = z.new_zeros(rows, cols)
    for i, j in m.nonzero().tolist():
        for plane, value in zip(z, t[:, i, j].tolist(), strict=True):
            difference = plane[i : i + rows, j : j + cols] - value
            costs.addcmul_(difference, difference, value=float(m[i, j]))
    return costs


def ssd_canvas(
    canvas: Float[Tensor, "c h w"],
    filled: Bool[Tensor, "h w"],
    exemplar: Float[Tensor, "c hz wz"],
    *,
    usable: Bool[Tensor, "hz wz"] | None = None,
) -> tuple[Float[Tensor, "rows cols"], Int[Tensor, "rows cols"]]:
    """Costs of the whole exemplar laid over a partly filled canvas, at every translation.

    C(d) = sum over p in the overlap, channels of (canvas(p) - exemplar(p - d))^2

    where the overlap holds the filled pixels that the exemplar, usable there, covers. It may
    hang out of the canvas on any side.

    Returns:
        Costs, infinite where nothing overlaps, and the pixels of each overlap; both are
        (h + hz - 1, w + wz - 1), and entry (i, j) is for the exemplar's first pixel at
        (i - hz + 1, j - wz + 1) of the canvas.

    Raises:
        ValueError: nothing is filled, or a filled pixel is not finite.

    Source: Kwatra et al. 2003 (Graphcut textures), entire patch matching, sections 3.1 and 3.2.

    Example:
        >>> z = torch.rand(3, 8, 8)
        >>> costs, areas = ssd_canvas(z, torch.ones(8, 8, dtype=torch.bool), z)
        >>> costs[7, 7].item(), areas[7, 7].item()
        (0.0, 64)
    """
    z, usable = known_exemplar(exemplar, usable)
    x, m = _known(canvas, filled, "canvas", "filled")
    if x.shape[0] != z.shape[0]:
        raise ValueError(
            f"canvas has {x.shape[0]} channels and exemplar {z.shape[0]}; give both the same"
        )
    (h, w), (hz, wz) = x.shape[1:], z.shape[1:]
    rows, cols = h + hz - 1, w + wz - 1
    size = (_good(rows), _good(cols))
    with threads(1):
        k = z.new_ones(hz, wz).double() if usable is None else usable.double()
        mean = ((x.double() * m).sum((1, 2)) / m.sum())[:, None, None]
        x, z = (x.double() - mean) * m, (z.double() - mean) * k
        energy, squares = x.square().sum(0), z.square().sum(0)
        fx, fe, fm = _forward(x, size), _forward(energy, size), _forward(m, size)
        fz, fs, fk = (_forward(a, size).conj() for a in (z, squares, k))
        both = torch.stack([fe * fk + fm * fs - 2 * (fx * fz).sum(0), fm * fk])
        found = torch.fft.irfft2(both, s=size).roll((hz - 1, wz - 1), (-2, -1))[:, :rows, :cols]
        areas = found[1].round().long()
        noise = _norm(x) * _norm(z) + _norm(energy) * _norm(k) + _norm(m) * _norm(squares)
        costs = torch.where(found[0] < _ROUNDING * noise, 0, found[0])
    return torch.where(areas > 0, costs, torch.inf).to(canvas.dtype), areas


def _good(n: int) -> int:
    """The least extent of at least n whose only factors are 2, 3 and 5: quick to transform."""
    while True:
        rest = n
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return n
        n += 1


def _forward(x: Tensor, size: Sequence[int]) -> Tensor:
    """Real transform of x with zeros below and to the right of it."""
    rows = torch.fft.rfft(x, n=size[1])  # the rows of zeros need no transform
    return torch.fft.fft(rows, n=size[0], dim=-2)


def _norm(x: Tensor) -> float:
    return float(x.square().sum().sqrt())
