"""Chaotic maps: sequences that never repeat and never settle, begun where a seed says.

Source: Shen et al. 2006, Completion-based texture design, section 3.3, equation 2.
"""

import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

_SETTLED = 8  # numbers in a row that are equal: the map rests


@runtime_checkable
class ChaoticMap(Protocol):
    """Numbers in [0, 1], one after another, without end."""

    def numbers(self) -> Iterator[float]: ...


@dataclass(frozen=True)
class Logistic:
    """x -> 1 - lam x^2, by magnitude; the paper's map and its first value.

    Source: Shen et al. 2006, equation 2.

    Example:
        >>> numbers = Logistic().numbers()
        >>> [round(next(numbers), 4) for _ in range(3)]
        [0.7623, 0.1623, 0.9473]
    """

    x0: float = 0.76234783
    lam: float = 2.0

    def __post_init__(self) -> None:
        _within("x0", self.x0, -1.0, 1.0)
        _within("lam", self.lam, 0.0, 2.0)

    def numbers(self) -> Iterator[float]:
        """Magnitudes of x, from x0 on."""
        x = self.x0
        while True:
            yield abs(x)
            x = 1 - self.lam * x * x


@dataclass(frozen=True)
class Tent:
    """x -> slope min(x, 1 - x). A slope of just 2 would lose a binary digit in every step.

    Example:
        >>> numbers = Tent(0.25).numbers()
        >>> [round(next(numbers), 2) for _ in range(3)]
        [0.25, 0.5, 1.0]
    """

    x0: float = 0.76234783
    slope: float = 1.99999

    def __post_init__(self) -> None:
        _within("x0", self.x0, 0.0, 1.0)
        _within("slope", self.slope, 0.0, 1.99999)

    def numbers(self) -> Iterator[float]:
        """The values of x, from x0 on."""
        x = self.x0
        while True:
            yield x
            x = self.slope * min(x, 1 - x)


@dataclass(frozen=True)
class Henon:
    """(x, y) -> (1 - a x^2 + y, b x), by the magnitude of x over 1.3.

    Source: Henon 1976, A two-dimensional mapping with a strange attractor.

    Example:
        >>> numbers = Henon().numbers()
        >>> all(0 <= next(numbers) <= 1 for _ in range(1000))
        True
    """

    x0: float = 0.3
    y0: float = 0.0
    a: float = 1.4
    b: float = 0.3

    def __post_init__(self) -> None:
        _within("x0", self.x0, -0.6, 0.6)  # beyond, some points fly off
        _within("y0", self.y0, -0.1, 0.1)
        _within("a", self.a, 0.0, 1.4)
        _within("b", self.b, 0.0, 0.3)

    def numbers(self) -> Iterator[float]:
        """Magnitudes of x over 1.3, from x0 on."""
        x, y = self.x0, self.y0
        while True:
            yield min(abs(x) / 1.3, 1.0)
            x, y = 1 - self.a * x * x + y, self.b * x


MAPS = ("logistic", "tent", "henon")


def chaotic_map(name: str = "logistic", seed: int = 0) -> ChaoticMap:
    """A map by name, begun where the seed says; seed 0 begins where the paper does.

    Raises:
        ValueError: an unknown name, or a negative seed.

    Example:
        >>> chaotic_map("logistic").x0, chaotic_map("henon", 7) == chaotic_map("henon", 7)
        (0.76234783, True)
    """
    if name not in MAPS:
        raise ValueError(f"map={name!r} is unknown; choose {', '.join(MAPS)}")
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed={seed} must lie in 0..2^63 - 1")
    if seed == 0:
        return Logistic() if name == "logistic" else Tent() if name == "tent" else Henon()
    share = random.Random(seed).random()  # near seeds begin far apart
    if name == "logistic":
        return Logistic(0.001 + 0.998 * share)
    return Tent(0.001 + 0.998 * share) if name == "tent" else Henon(1.2 * share - 0.6)


def whole_numbers(source: ChaoticMap) -> Iterator[int]:
    """h(k): the numbers of a map as whole ones, 0..255.

    Raises:
        ValueError: the map has come to rest, as Logistic(x0=0.5) does at once.

    Example:
        >>> numbers = whole_numbers(Logistic())
        >>> [next(numbers) for _ in range(4)]
        [194, 41, 242, 203]
    """
    last, same = -1.0, 0
    for x in source.numbers():
        same = same + 1 if x == last else 0
        if same >= _SETTLED:
            raise ValueError(f"{source} rests at {x:g}; begin it elsewhere")
        last = x
        yield round(255 * x)


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name}={value} must lie in {low}..{high}")
