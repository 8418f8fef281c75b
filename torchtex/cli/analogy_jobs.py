"""The files of an analogy and how they make one, and what its methods return."""

import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchtex.cli.files import check_masks, exemplar_path

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch

    from torchtex.recipes.analogy import Analogy
    from torchtex.recipes.montage import Montage
    from torchtex.result import Result

LOWERING = ("cms", "random")  # methods that minimise the energy of K and N
OFF = 0.02  # of white: more than this, reduced again, is no enlargement of the small picture


@dataclass(frozen=True)
class Finished:
    """A picture, with what else is to be told about it."""

    made: "Montage | Result"
    curve: tuple[float, ...] = ()
    about: dict[str, Any] = field(default_factory=dict)
    corrected: "torch.Tensor | None" = None

    @property
    def texture(self) -> "torch.Tensor":
        """The picture."""
        return self.made.texture if self.corrected is None else self.corrected

    @property
    def field(self) -> Any:
        """Where every pixel is from."""
        return self.made.field

    def report(self) -> dict[str, Any]:
        """Settings, timing and energies."""
        return self.made.report() | self.about


@dataclass(frozen=True)
class Job:
    """The files, and how they make an analogy."""

    sources: tuple[str, ...]
    mapped: tuple[str, ...]
    constraints: tuple[str, ...]
    weights: tuple[float, ...]
    detail: float | None
    back_project: bool | None
    transfer: bool
    blur: float | None
    contrast: float | None
    numbers: bool
    match: bool
    masks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        kinds = {"detail": self.detail is not None, "transfer": self.transfer,
                 "numbers": self.numbers}  # fmt: skip
        chosen = [name for name, on in kinds.items() if on]
        if len(chosen) > 1:
            raise ValueError(f"{chosen[0]} does not go with {chosen[1]}; leave one of them out")
        for name, value in (("blur", self.blur), ("contrast", self.contrast)):
            if value is not None and not self.transfer:
                raise ValueError(f"{name}={value} needs --transfer; leave it out")
        if self.back_project is not None and self.detail is None:
            raise ValueError("back_project needs --detail; leave it out")
        if self.masks:
            check_masks(self.sources, self.masks)
        if self.match and (self.numbers or self.detail is not None):
            raise ValueError(f"match_luminance does not go with {chosen[0]}; leave it out")
        if self.detail is not None and not 2 <= self.detail < float("inf"):
            raise ValueError(f"detail={self.detail} must be at least 2, the factor to enlarge by")
        if chosen and len(self.constraints) > 1:
            raise ValueError(
                f"constraint: {len(self.constraints)} given; {chosen[0]} takes one"
            )  # fmt: skip
        if chosen and chosen[0] != "detail" and len(self.sources) > 1:
            raise ValueError(f"source: {len(self.sources)} given; {chosen[0]} takes one")
        self._check_mapped()

    def _check_mapped(self) -> None:
        if self.detail is not None or self.transfer:
            if self.mapped:
                name = "transfer" if self.transfer else "detail"
                raise ValueError(
                    f"mapped={self.mapped[0]!r}: {name} makes it of the source; leave it out"
                )
            return
        wanted = len(self.sources) * len(self.constraints)
        if len(self.mapped) != wanted:
            raise ValueError(
                f"mapped: {len(self.mapped)} given for {len(self.sources)} sources and "
                f"{len(self.constraints)} constraints; repeat --mapped {wanted} times, those of "
                "the first source first"
            )

    def read(self) -> dict[str, Path]:
        """Files that decide the pixels, by the names they were given under."""
        found: dict[str, Path] = {}
        for kind, names in (
            ("source", self.sources), ("mapped", self.mapped), ("constraint", self.constraints),
            ("mask", self.masks),
        ):  # fmt: skip
            for name in names:
                path = found[name] = exemplar_path(name) if kind == "source" else Path(name)
                if not path.exists():
                    raise ValueError(f"{kind}={name!r}: there is no such file; check the name")
        return found

    def problem(self, quiet: bool) -> "Analogy":
        """Loads, and makes what is not given."""
        made = self._unmasked(quiet)
        if not self.masks:
            return made
        from torchtex import image as images

        each = zip(self.masks, made.shapes, strict=True)
        return replace(
            made, masks=tuple(images.load_mask(name, shape, name="mask") for name, shape in each)
        )

    def _unmasked(self, quiet: bool) -> "Analogy":
        from torchtex.recipes.analogy import Analogy
        from torchtex.recipes.transfers import luminance_matched, transfer_problem

        sources = [_load(str(exemplar_path(name)), "source") for name in self.sources]
        constraints = tuple(_load(name, "constraint") for name in self.constraints)
        if self.detail is not None:
            return self._detail(sources, constraints[0])
        if self.transfer:
            made = transfer_problem(
                sources[0], constraints[0], blur=self.blur or 0.0, match=self.match,
                contrast=1.0 if self.contrast is None else self.contrast,
            )  # fmt: skip
            return replace(made, weights=self.weights)
        maps = [_load(name, "mapped") for name in self.mapped]
        if self.numbers:
            maps, constraints = _snapped(maps[0], constraints[0], quiet)
        count = len(constraints)
        mapped = tuple(tuple(maps[i : i + count]) for i in range(0, len(maps), count))
        problem = Analogy(tuple(sources), mapped, constraints, self.weights)
        return luminance_matched(problem) if self.match else problem

    def _detail(self, sources: "list[torch.Tensor]", low: "torch.Tensor") -> "Analogy":
        from torchtex.recipes.analogy import Analogy
        from torchtex.recipes.detail import detail_problem

        assert self.detail is not None
        each = [detail_problem(s, low, self.detail) for s in sources]
        return Analogy(
            tuple(p.sources[0] for p in each), tuple(p.mapped[0] for p in each),
            each[0].constraints, self.weights,
        )  # fmt: skip

    def judged(self, done: Finished, quiet: bool) -> Finished:
        """With --detail, corrects the colours and tells how far off the small picture all is."""
        from torchtex.recipes.detail import back_projected, detail_error, sharpness_ratio

        if self.detail is None:
            return done
        low = _load(self.constraints[0], "constraint")
        raw = detail_error(done.texture, low, self.detail)
        words = f"reduced again, the output is {100 * raw:.2f} % off"
        if self.back_project is not False:
            done = replace(done, corrected=back_projected(done.texture, low, self.detail))
        error = detail_error(done.texture, low, self.detail)
        sharp = sharpness_ratio(done.texture, _load(str(exemplar_path(self.sources[0])), "source"))
        if done.corrected is not None:
            words += f", and {100 * error:.2f} % with its colours corrected"
        words += f"; it is {sharp:.2f} times as sharp as the source"
        if error > OFF:
            words += f". More than {100 * OFF:g} % is far: raise K, or give a sample more alike"
        if not quiet:
            print(words, file=sys.stderr)
        about = {"detail_error": error, "detail_error_of_copies": raw, "sharpness": sharp}
        return replace(done, about=done.about | about)


@dataclass(frozen=True)
class How:
    """A method and its options."""

    method: str
    k: float | None
    n: int | None
    turns: bool
    mirrors: bool
    kappa: float | None
    moves: int | None
    tolerance: float | None
    paper: bool
    detail: bool
    seed: int

    def run(self, problem: "Analogy", watch: "Callable[[Any], None]") -> Finished:
        """The output of the method."""
        from torchtex.recipes import image_analogies, rivals

        if self.method in LOWERING:
            return self._lowered(problem, watch)
        if self.method == "analogies":
            kappa = 2.0 if self.kappa is None else self.kappa
            return Finished(
                image_analogies.image_analogies(
                    problem, kappa=kappa, seed=self.seed, on_step=watch
                )
            )  # fmt: skip
        if self.method == "quilt":
            return Finished(rivals.constrained_quilting(problem, seed=self.seed, on_step=watch))
        made = rivals.guided(problem, seed=self.seed, on_step=watch)
        return Finished(made, made.energies)

    def limit(self, k: float) -> float | None:
        """The tolerance; that of the paper for detail, which is sharper if moves end sooner."""
        if self.tolerance is None and self.detail:
            return 5 * (k + 2)
        return self.tolerance

    def _lowered(self, problem: "Analogy", watch: "Callable[[Any], None]") -> Finished:
        from torchtex.recipes import cms, rivals

        k, n = 1.0 if self.k is None else self.k, 3 if self.n is None else self.n
        made: cms.CmsResult
        if self.method == "cms":
            made = cms.cms(
                problem, K=k, N=n, tolerance=self.limit(k), screened=not self.paper,
                turns=self.turns, mirrors=self.mirrors, seed=self.seed, on_step=watch,
            )  # fmt: skip
        else:
            made = rivals.random_placement(
                problem, K=k, N=n, moves=500 if self.moves is None else self.moves,
                turns=self.turns, mirrors=self.mirrors, seed=self.seed, on_step=watch,
            )  # fmt: skip
        about = {"energies": asdict(made.energies), "moves": len(made.moves), "tried": made.tried}
        return Finished(made.montage, tuple(move.energy for move in made.moves), about)


def _load(path: str, name: str) -> "torch.Tensor":
    from torchtex import image as images

    return images.load(path, alpha=False, name=name).image


def _snapped(
    mapped: "torch.Tensor", constraint: "torch.Tensor", quiet: bool
) -> "tuple[list[torch.Tensor], tuple[torch.Tensor, ...]]":
    from torchtex.recipes.region_maps import snapped

    clean = snapped(mapped, constraint)
    if any(clean.changed) and not quiet:
        print(
            f"numbers: {clean.changed[0]} pixels of mapped and {clean.changed[1]} of constraint "
            f"were snapped to {len(clean.palette)} colours",
            file=sys.stderr,
        )
    return [clean.mapped], (clean.constraint,)
