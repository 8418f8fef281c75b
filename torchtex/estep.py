"""E-steps: pixels given labels."""

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.energy import Objective
from torchtex.quadratic import minimise, threads


@runtime_checkable
class EStep(Protocol):
    """Lowers an objective from x; may stop early, must not raise it."""

    def __call__(
        self, objective: Objective, x: Float[Tensor, "c h w"]
    ) -> Float[Tensor, "c h w"]: ...


@dataclass(frozen=True)
class ClosedForm:
    """Minimises the sum of the quadratic bounds of all terms.

    A weighted average when the quadratic is diagonal, conjugate gradients otherwise.

    Raises:
        ValueError: when called with a term that has no quadratic bound.
    """

    tolerance: float = 1e-4
    steps: int = 100

    def __call__(self, objective: Objective, x: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        bound = objective.quadratic_bound(x)
        if bound is None:
            raise ValueError(
                "estep=ClosedForm() needs a quadratic bound of every term; "
                "use Auto() or Descend() with this feature or control"
            )
        return minimise(bound, x, tolerance=self.tolerance, steps=self.steps)


@dataclass(frozen=True)
class Descend:
    """Lowers the objective by torch.optim, and returns the better of old and new.

    Args:
        optimizer: "lbfgs" or "adam".
        steps: iterations per E-step.
        rate: learning rate; 1 for LBFGS and 0.02 for Adam unless given.
    """

    optimizer: Literal["lbfgs", "adam"] = "lbfgs"
    steps: int = 20
    rate: float | None = None

    def __post_init__(self) -> None:
        if self.optimizer not in ("lbfgs", "adam"):
            raise ValueError(f'optimizer="{self.optimizer}" must be "lbfgs" or "adam"')
        if self.steps < 1:
            raise ValueError(f"steps={self.steps} must be at least 1")
        if self.rate is not None and not self.rate > 0:
            raise ValueError(f"rate={self.rate} must be above 0, or None")

    def __call__(self, objective: Objective, x: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        before = objective(x.detach())
        y = x.detach().clone(memory_format=torch.contiguous_format).requires_grad_()
        optimizer: torch.optim.Optimizer
        if self.optimizer == "lbfgs":
            optimizer = torch.optim.LBFGS(
                [y], lr=self.rate or 1.0, max_iter=self.steps, line_search_fn="strong_wolfe"
            )
        else:
            optimizer = torch.optim.Adam([y], lr=self.rate or 0.02)

        many = torch.get_num_threads()

        def closure() -> float:
            optimizer.zero_grad()
            with threads(many):
                value = objective(y)
                value.backward()
            return float(value.detach())

        with torch.enable_grad(), threads(1):  # the optimizer's sums depend on their number
            for _ in range(1 if self.optimizer == "lbfgs" else self.steps):
                optimizer.step(closure)
        y = y.detach()
        return y if bool(objective(y) <= before) else x


@dataclass(frozen=True)
class Auto:
    """`closed` when every term has a quadratic bound, else `descend`."""

    closed: ClosedForm = ClosedForm()
    descend: Descend = Descend()

    def __call__(self, objective: Objective, x: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        bound = objective.quadratic_bound(x)
        if bound is None:
            return self.descend(objective, x)
        return minimise(bound, x, tolerance=self.closed.tolerance, steps=self.closed.steps)
