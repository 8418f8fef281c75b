"""Quadratic functions of an image, and their minimum."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


def dot(a: Float[Tensor, "c h w"], b: Float[Tensor, "c h w"]) -> Float[Tensor, ""]:
    """Inner product, summed row by row so that its bits do not depend on the thread count."""
    return (a * b).sum(-1).sum()


def rowwise_sum(values: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Sum in blocks of 1024, so that its bits do not depend on the thread count.

    Example:
        >>> rowwise_sum(torch.ones(3000)).item()
        3000.0
    """
    whole = values.shape[0] // 1024 * 1024
    return values[:whole].view(-1, 1024).sum(1).sum() + values[whole:].sum()


@contextmanager
def threads(count: int) -> Iterator[None]:
    """That many threads inside; one where a routine's bits would depend on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True)
class Quadratic:
    """q(x) = <x, Ax> - 2 <b, x> + constant, with A symmetric and positive semidefinite.

    Args:
        apply: x -> Ax.
        b, constant: the other two terms.
        weight: (c, h, w), roughly how strongly A holds each pixel; scales the preconditioner.
        response: (c, h, w // 2 + 1), frequency response of A for unit weight, or None when A
            is diagonal; then `weight` is the diagonal, exactly.

    Example:
        >>> q = diagonal(torch.full((1, 2, 2), 2.0), torch.ones(1, 2, 2))
        >>> minimise(q, torch.zeros(1, 2, 2)).flatten().tolist()
        [1.0, 1.0, 1.0, 1.0]
    """

    apply: Callable[[Tensor], Tensor]
    b: Tensor
    constant: Tensor
    weight: Tensor
    response: Tensor | None = None

    def __call__(self, x: Float[Tensor, "c h w"]) -> Float[Tensor, ""]:
        return dot(x, self.apply(x) - 2 * self.b) + self.constant


def diagonal(weight: Float[Tensor, "#c h w"], target: Float[Tensor, "c h w"]) -> Quadratic:
    """sum of weight (x - target)^2 as a `Quadratic`.

    Example:
        >>> diagonal(torch.ones(1, 1, 1), torch.ones(1, 1, 1))(torch.zeros(1, 1, 1)).item()
        1.0
    """
    b = weight * target
    return Quadratic(lambda x: weight * x, b, dot(b, target), weight.expand_as(target))


def total(terms: list[tuple[float, Quadratic]]) -> Quadratic:
    """Weighted sum of quadratics.

    Example:
        >>> q = diagonal(torch.ones(1, 1, 1), torch.ones(1, 1, 1))
        >>> total([(2.0, q), (1.0, q)])(torch.zeros(1, 1, 1)).item()
        3.0
    """

    def apply(x: Tensor) -> Tensor:
        return sum((c * q.apply(x) for c, q in terms), torch.zeros_like(x))

    b = sum((c * q.b for c, q in terms), torch.zeros_like(terms[0][1].b))
    constant = sum((c * q.constant for c, q in terms), b.new_zeros(()))
    weight = sum((c * q.weight for c, q in terms), torch.zeros_like(b))
    response = None
    if any(q.response is not None for _, q in terms):
        shares = [c * float(q.weight.mean(-1).mean()) for c, q in terms]
        whole = sum(shares)
        one = b.new_ones(())
        parts = [
            share / whole * (one if q.response is None else q.response)
            for share, (_, q) in zip(shares, terms, strict=True)
        ]
        response = sum(parts[1:], parts[0])
    return Quadratic(apply, b, constant, weight, response)


def minimise(
    quadratic: Quadratic,
    x: Float[Tensor, "c h w"],
    *,
    tolerance: float = 1e-5,
    steps: int = 200,
) -> Float[Tensor, "c h w"]:
    """The minimum: a division when A is diagonal, else preconditioned conjugate gradients from x.

    The preconditioner is D^-1/2 F^-1 (1 / response) F D^-1/2 with D the weights and F the
    Fourier transform. Without it low frequencies, which A of a gradient energy hardly holds,
    converge last and the result fades to grey.

    Args:
        tolerance: stops when the residual falls below this share of b, both over the weights.
        steps: most CG steps.
    """
    floor = torch.finfo(x.dtype).tiny
    if quadratic.response is None:
        held = quadratic.weight > floor
        return torch.where(held, quadratic.b / quadratic.weight.clamp(min=floor), x)
    response = quadratic.response.clamp(min=1e-4 * float(quadratic.response.max()))
    size = (x.shape[1], x.shape[2])
    scale = quadratic.weight.clamp(min=1e-6 * float(quadratic.weight.max())).rsqrt()

    def precondition(residual: Tensor) -> Tensor:
        spectrum = torch.fft.rfft2(scale * residual) / response
        return scale * torch.fft.irfft2(spectrum, s=size)

    residual = quadratic.b - quadratic.apply(x)
    # in units of colour: a heavy control must not hide what is wrong beside it
    wanted = quadratic.b * scale.square()
    enough = tolerance**2 * dot(wanted, wanted)
    z = precondition(residual)
    direction, gain = z, dot(residual, z)
    for _ in range(steps):
        error = residual * scale.square()
        if dot(error, error) <= enough:
            break
        image = quadratic.apply(direction)
        curvature = dot(direction, image)
        if not bool(curvature > 0):  # what is left is rounding
            break
        step = gain / curvature
        x = x + step * direction
        residual = residual - step * image
        z = precondition(residual)
        gain, before = dot(residual, z), gain
        direction = z + gain / before * direction
    return x
