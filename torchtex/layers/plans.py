"""Plans: which layer is moved, turned, mirrored or scaled, and how far; drawn by a chaotic map.

The numbers x(k) of a map become whole numbers h(k) in 0..255, and

    n = h(k) mod u        how far
    m = n mod v           which of the operations T, R, M, S

The next number of the sequence chooses the direction, which the paper leaves open. A plan is plain
data: written as JSON, changed by hand, read again.

Source: Shen et al. 2006, Completion-based texture design, section 3.3, equations 1 and 2.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

from torchtex.layers.chaos import chaotic_map, whole_numbers

Kind = Literal["translate", "rotate", "mirror", "scale"]
KINDS: tuple[Kind, ...] = get_args(Kind)
DIRECTIONS: Mapping[str, tuple[str, ...]] = {
    "translate": ("up", "down", "left", "right"),
    "rotate": ("clockwise", "anticlockwise"),
    "mirror": ("left-right", "up-down"),
    "scale": ("",),
}


@dataclass(frozen=True)
class Ranges:
    """How far operations may go, from the least to the most.

    Args:
        translate: shares of the picture's shorter side.
        rotate: degrees.
        scale: factors; those of the paper.

    Raises:
        ValueError: an empty range, or a scale outside 0.1..10.

    Example:
        >>> Ranges(rotate=(0.0, 30.0)).scale
        (0.8, 1.2)
    """

    translate: tuple[float, float] = (0.05, 0.25)
    rotate: tuple[float, float] = (10.0, 180.0)
    scale: tuple[float, float] = (0.8, 1.2)

    def __post_init__(self) -> None:
        for name, most in (("translate", 1.0), ("rotate", 360.0), ("scale", 10.0)):
            low, high = getattr(self, name)
            least = 0.1 if name == "scale" else 0.0
            if not least <= low <= high <= most:
                raise ValueError(
                    f"{name}={low}:{high} must be two numbers in {least:g}..{most:g}, the lesser "
                    "first"
                )


@dataclass(frozen=True)
class Selection:
    """How a whole number h chooses the operation and its extent.

    Args:
        u, v: n = h mod u, and the operation is number n mod v.
        xi: the extent is xi n, brought into the operation's range; None spreads n = 0..u - 1
            evenly over the range. The paper's example, u=10, v=4 and xi=0.13, gives scales of
            0.39 and 0.91 alone, so the default spreads more values.

    Raises:
        ValueError: u outside 4..256, or v outside 1..4.

    Example:
        >>> chosen = Selection(u=10, v=4, xi=0.13)
        >>> chosen.kind(37), round(chosen.extent(37, (0.8, 1.2)), 2)
        ('scale', 0.91)
    """

    u: int = 101
    v: int = 4
    xi: float | None = None

    def __post_init__(self) -> None:
        if not 4 <= self.u <= 256:
            raise ValueError(f"u={self.u} must lie in 4..256")
        if not 1 <= self.v <= len(KINDS):
            raise ValueError(f"v={self.v} must lie in 1..{len(KINDS)}, the number of operations")
        if self.xi is not None and not 0 < self.xi < math.inf:
            raise ValueError(f"xi={self.xi} must be above 0, and finite")

    def kind(self, h: int) -> Kind:
        """The operation that h chooses."""
        return KINDS[h % self.u % self.v]

    def extent(self, h: int, span: tuple[float, float]) -> float:
        """How far, within a range."""
        n, (low, high) = h % self.u, span
        if self.xi is not None:
            return min(max(self.xi * n, low), high)
        return low + (high - low) * n / (self.u - 1)


@dataclass(frozen=True)
class Operation:
    """One deformation of one layer.

    Args:
        kind: translate, rotate, mirror or scale.
        direction: one of `DIRECTIONS[kind]`.
        amount: share of the picture's shorter side, degrees, or factor; 0 for mirror.

    Raises:
        ValueError: a kind, direction or amount that there is not.

    Example:
        >>> Operation("rotate", "clockwise", 30.0).amount
        30.0
    """

    kind: Kind
    direction: str = ""
    amount: float = 0.0

    def __post_init__(self) -> None:
        known = DIRECTIONS[self.kind]
        if self.direction not in known:
            choice = ", ".join(known) if known != ("",) else "none"
            raise ValueError(f"direction={self.direction!r} of {self.kind}: choose {choice}")
        if not math.isfinite(self.amount) or self.amount < 0:
            raise ValueError(f"amount={self.amount} of {self.kind} must be at least 0, and finite")
        if self.kind == "scale" and not 0.1 <= self.amount <= 10:
            raise ValueError(f"amount={self.amount} of scale must lie in 0.1..10")


@dataclass(frozen=True)
class Plan:
    """The operations of every layer, in the order in which they are applied.

    Example:
        >>> plan = Plan(((Operation("scale", "", 0.9),), ()))
        >>> Plan.read(plan.plain()) == plan
        True
    """

    layers: tuple[tuple[Operation, ...], ...]

    def plain(self) -> list[list[dict[str, Any]]]:
        """The same as lists and dictionaries, for JSON."""
        return [[asdict(operation) for operation in layer] for layer in self.layers]

    @staticmethod
    def read(value: Any) -> "Plan":
        """A plan from what `plain` gave, perhaps changed by hand.

        Raises:
            ValueError: what is wrong, with the numbers of layer and operation.
        """
        if not isinstance(value, list) or not all(isinstance(layer, list) for layer in value):
            raise ValueError("plan is no list of lists of operations; write one list per layer")
        return Plan(
            tuple(
                tuple(_operation(item, f"layer {i}, operation {j}") for j, item in enumerate(layer))
                for i, layer in enumerate(value)
            )
        )


@dataclass(frozen=True)
class Chaos:
    """How plans are drawn.

    Args:
        name: of the map: logistic, tent or henon.
        combined: operations of different kinds on one layer.
        iterations: how often that is done.
        selection, ranges: see there.

    Raises:
        ValueError: a number out of range, or an unknown map.

    Example:
        >>> plan = Chaos(combined=2).plan(3, seed=1)
        >>> len(plan.layers), len(plan.layers[0])
        (3, 2)
    """

    name: str = "logistic"
    combined: int = 2
    iterations: int = 1
    selection: Selection = field(default_factory=Selection)
    ranges: Ranges = field(default_factory=Ranges)

    def __post_init__(self) -> None:
        chaotic_map(self.name)
        if not 1 <= self.combined <= self.selection.v:
            raise ValueError(
                f"combined={self.combined} must lie in 1..{self.selection.v}, the operations that "
                "v allows"
            )
        if not 1 <= self.iterations <= 100:
            raise ValueError(f"iterations={self.iterations} must lie in 1..100")

    def plan(self, layers: int, seed: int = 0) -> Plan:
        """Operations for so many layers; the same seed gives the same plan."""
        numbers = whole_numbers(chaotic_map(self.name, seed))
        made = []
        for _ in range(layers):
            mine: list[Operation] = []
            for _ in range(self.iterations):
                mine += self._combination(numbers)
            made.append(tuple(mine))
        return Plan(tuple(made))

    def _combination(self, numbers: Iterator[int]) -> list[Operation]:
        found: dict[Kind, Operation] = {}
        while len(found) < self.combined:
            h = next(numbers)
            kind = self.selection.kind(h)
            if kind not in found:
                known = DIRECTIONS[kind]
                span = getattr(self.ranges, kind, (0.0, 0.0))
                direction = known[next(numbers) % len(known)]
                found[kind] = Operation(kind, direction, self.selection.extent(h, span))
        return list(found.values())


def _operation(item: Any, where: str) -> Operation:
    known = {"kind": str, "direction": str, "amount": (int, float)}
    if not isinstance(item, dict) or not set(item) <= set(known) or "kind" not in item:
        raise ValueError(f"plan: {where} must be an object of kind, direction and amount")
    for name, value in item.items():
        if not isinstance(value, known[name]) or isinstance(value, bool):  # type: ignore[arg-type]
            raise ValueError(f"plan: {where} has {name}={value!r}, which is of another kind")
    if item["kind"] not in KINDS:
        raise ValueError(
            f"plan: {where}: kind={item['kind']!r} is no operation; choose {', '.join(KINDS)}"
        )
    try:
        return Operation(item["kind"], item.get("direction", ""), float(item.get("amount", 0.0)))
    except ValueError as error:
        raise ValueError(f"plan: {where}: {error}") from None
