"""The loop: labels given pixels, pixels given labels, on one level."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from torchtex.energy import Energy, Objective
from torchtex.estep import EStep
from torchtex.model import TextureModel


@dataclass(frozen=True)
class HalfStep:
    """What `on_step` is given after each half-step.

    Args:
        step: iteration of the loop, from 0.
        half: "M" after the labels changed, "E" after the pixels changed.
        energy: of the objective.
        changed: share of sites whose label changed in the last M-step.
        texture: the pixels now.
    """

    step: int
    half: str
    energy: float
    changed: float
    texture: Tensor


@dataclass(frozen=True)
class Fit:
    """Result of the loop: pixels, labels per model, energy after each half-step."""

    texture: Float[Tensor, "c h w"]
    labels: tuple[Int[Tensor, "_"], ...]
    energies: tuple[float, ...]


def em(
    x: Float[Tensor, "c h w"],
    models: Sequence[TextureModel],
    controls: Sequence[tuple[float, Energy]],
    estep: EStep,
    *,
    steps: int,
    labels: Sequence[Int[Tensor, "_"]] | None = None,
    on_step: Callable[[HalfStep], None] | None = None,
) -> Fit:
    """Alternates M- and E-steps until no label changes, or `steps` times.

    The first M-step has no energy before it; the energies listed are those after each half-step.
    With completeness=0 and without soft constraints they never increase; with soft constraints
    an M-step may raise them, since it also asks of a match that it agrees with the target.

    Raises:
        ValueError: fewer steps than one.

    Source: Kwatra et al. 2005, Algorithms 1 and 2.
    """
    if steps < 1:
        raise ValueError(f"steps={steps} must be at least 1")
    energies: list[float] = []
    current = None if labels is None else tuple(labels)

    def report(step: int, half: str, objective: Objective, changed: float) -> None:
        energies.append(float(objective(x)))
        if on_step is not None:
            on_step(HalfStep(step, half, energies[-1], changed, x))

    for step in range(steps):
        old = current
        current = tuple(
            model.match(x, None if old is None else old[number], controls)
            for number, model in enumerate(models)
        )
        changed = 1.0 if old is None else _changed(old, current)
        if old is not None and changed == 0 and step:
            break
        terms = [(1.0, model.energy(some)) for model, some in zip(models, current, strict=True)]
        objective = Objective((*terms, *controls))
        report(step, "M", objective, changed)
        x = estep(objective, x)
        report(step, "E", objective, changed)
    assert current is not None
    return Fit(x, current, tuple(energies))


def _changed(old: Sequence[Tensor], new: Sequence[Tensor]) -> float:
    differ = sum(int((a != b).sum()) for a, b in zip(old, new, strict=True))
    return differ / sum(len(a) for a in new)
