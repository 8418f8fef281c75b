"""The result of a synthesis, and what it keeps on the way."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex import image as images
from torchtex.em import HalfStep
from torchtex.extras import needed
from torchtex.labels import LabelField, label_arrays, label_field
from torchtex.schedule import Level
from torchtex.sources import UNREADABLE


@dataclass(frozen=True)
class Progress:
    """What `on_step` is given.

    Args:
        level, levels: number of the level from 0, and how many there are.
        schedule: the level's settings.
        half: the half-step that has just ended; `half.texture` is a preview.
        done: share of the work that is done, in [0, 1], by an estimate.
    """

    level: int
    levels: int
    schedule: Level
    half: HalfStep
    done: float

    @property
    def note(self) -> str:
        """What goes on, in a few words."""
        level = self.schedule
        return (
            f"level {self.level + 1} of {self.levels}: scale {level.scale:g}, window {level.size}"
        )

    @property
    def detail(self) -> str:
        """The energy, as text."""
        return f"energy {self.half.energy:.4g}"

    @property
    def texture(self) -> Float[Tensor, "c h w"]:
        """A preview."""
        return self.half.texture


def at_full_size(
    on_step: Callable[[Progress], None] | None, size: tuple[int, int]
) -> Callable[[Progress], None] | None:
    """The same callback, given previews of the texture's own size at coarse levels too.

    Example:
        >>> at_full_size(None, (32, 32)) is None
        True
    """
    if on_step is None:
        return None

    def told(progress: Progress) -> None:
        whole = images.resize(progress.half.texture, size)
        on_step(replace(progress, half=replace(progress.half, texture=whole)))

    return told


@dataclass(frozen=True)
class Trace:
    """Record of one level: its settings, the energy after each half-step, seconds, last pixels."""

    level: Level
    energies: tuple[float, ...]
    sites: int
    seconds: float
    snapshot: Float[Tensor, "c _ _"]


@dataclass(frozen=True)
class Result:
    """A texture, where it came from, and how it was made.

    Args:
        texture: (c, h, w) in [0, 1].
        labels: label of each site of the finest grid, in its label space.
        field: positions, weights and grid: renders aligned maps.
        traces: one per level.
        seconds: of the whole synthesis.
        seed: of the run.
        settings: plain values that describe the run.
    """

    texture: Float[Tensor, "c h w"]
    labels: Int[Tensor, "n"]
    field: LabelField
    traces: tuple[Trace, ...]
    seconds: float
    seed: int
    settings: Mapping[str, Any]

    @property
    def offsets(self) -> Int[Tensor, "ny nx 2"]:
        """Offset field; see `LabelField.offsets`."""
        return self.field.offsets

    @property
    def source_map(self) -> Int[Tensor, "h w 3"]:
        """Exemplar, row and column of each pixel; see `LabelField.source_map`."""
        return self.field.source_map()

    @property
    def energies(self) -> tuple[float, ...]:
        """Energy after each half-step, all levels in order, per site."""
        return tuple(e / trace.sites for trace in self.traces for e in trace.energies)

    def apply(
        self, maps: Float[Tensor, "k _ _"] | Sequence[Float[Tensor, "k _ _"]]
    ) -> Float[Tensor, "k h w"]:
        """Renders maps aligned with the exemplars with the same labels and weights."""
        return self.field.apply(maps)

    def save(self, path: str | Path, *, bits: Literal[8, 16] = 8) -> None:
        """Writes the texture; a PNG also holds the settings, as JSON in the text chunk torchtex."""
        images.save(path, self.texture, bits=bits, metadata={"torchtex": json.dumps(self.report())})

    def report(self) -> dict[str, Any]:
        """Settings, seed, timings and energies as plain values."""
        return {
            "seed": self.seed,
            "seconds": self.seconds,
            "settings": dict(self.settings),
            "levels": [
                {
                    **asdict(trace.level),
                    "sites": trace.sites,
                    "seconds": trace.seconds,
                    "energies": list(trace.energies),
                }
                for trace in self.traces
            ],
        }

    def plot(self) -> Any:
        """The energy curve as a matplotlib figure, with the last texture of each level.

        Source: the layout of Kwatra et al. 2005, fig. 3.

        Raises:
            ImportError: matplotlib is missing.
        """
        figure = needed("matplotlib.figure", "plot").Figure(
            figsize=(2.2 * len(self.traces), 5), layout="constrained"
        )
        grid = figure.add_gridspec(2, len(self.traces), height_ratios=(2, 1))
        curve, start = figure.add_subplot(grid[0, :]), 0
        for number, trace in enumerate(self.traces):
            energies = [e / trace.sites for e in trace.energies]
            name = f"{trace.level.scale:g}, {trace.level.size} px"
            curve.plot(range(start, start + len(energies)), energies, marker=".", label=name)
            start += len(energies)
            axes = figure.add_subplot(grid[1, number])
            axes.imshow(
                trace.snapshot[:3].mean(0).cpu().numpy()
                if len(trace.snapshot) != 3
                else trace.snapshot.clamp(0, 1).permute(1, 2, 0).cpu().numpy(),
                cmap="gray",
            )
            axes.set_title(name)
            axes.set_axis_off()
        curve.set_xlabel("half-step")
        curve.set_ylabel("energy per site")
        curve.legend()
        return figure


@dataclass(frozen=True)
class Checkpoint:
    """All that a run needs to go on after the levels that are done.

    Args:
        seed, settings: of the run.
        randomness: state of its generator.
        traces: one per level that is done; the last holds the pixels.
        labels, field: of the last level.

    Example:
        >>> exemplar, kept = torch.rand(1, 32, 32), []
        >>> whole = torchtex.synthesize(exemplar, (32, 32), on_level=kept.append)
        >>> again = torchtex.synthesize(exemplar, (32, 32), resume=kept[0])
        >>> torch.equal(again.texture, whole.texture)
        True
    """

    seed: int
    settings: Mapping[str, Any]
    randomness: Tensor
    traces: tuple[Trace, ...] = ()
    labels: Int[Tensor, "n"] | None = None
    field: LabelField | None = None

    @property
    def texture(self) -> Float[Tensor, "c h w"]:
        """The pixels of the last level that is done."""
        return self.traces[-1].snapshot

    def checked(self, seed: int, settings: Mapping[str, Any], like: Tensor) -> "Checkpoint":
        """This checkpoint, for a run with the given settings, on its device.

        Raises:
            ValueError: it is of a run with another seed or other settings.
        """
        mine, theirs = dict(self.settings), json.loads(json.dumps(dict(settings)))
        mine["seed"], theirs["seed"] = self.seed, seed
        mine = json.loads(json.dumps(mine))
        differ = [name for name in theirs if mine.get(name) != theirs[name]]
        if differ or not self.traces or self.labels is None or self.field is None:
            name = differ[0] if differ else "levels"
            raise ValueError(
                f"resume: the checkpoint is of a run with {name}={mine.get(name)} and this one "
                f"has {theirs.get(name)}; give the same options, or begin anew"
            )
        field = replace(
            self.field,
            positions=self.field.positions.to(like.device),
            weights=self.field.weights.to(like),
        )
        traces = tuple(replace(t, snapshot=t.snapshot.to(like)) for t in self.traces)
        labels = self.labels.to(like.device)
        return replace(self, settings=settings, traces=traces, labels=labels, field=field)

    def save(self, path: str | Path) -> None:
        """Writes an .npz file.

        Raises:
            ValueError: the file cannot be written, or no level is done.
        """
        if self.field is None or self.labels is None:
            raise ValueError("checkpoint: no level is done; save one that on_level was given")
        head = {
            "seed": self.seed,
            "settings": dict(self.settings),
            "levels": [
                {"level": asdict(t.level), "energies": t.energies, "sites": t.sites,
                 "seconds": t.seconds}
                for t in self.traces
            ],
        }  # fmt: skip
        arrays: dict[str, Any] = {
            f"texture{n}": trace.snapshot.cpu().numpy() for n, trace in enumerate(self.traces)
        }
        with images.atomic_write(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                head=np.array(json.dumps(head)),
                randomness=self.randomness.numpy(),
                labels=self.labels.cpu().numpy(),
                **label_arrays(self.field),
                **arrays,
            )

    @staticmethod
    def load(path: str | Path) -> "Checkpoint":
        """Reads a file that `save` wrote.

        Raises:
            ValueError: no such file, or another kind of file.
        """
        try:
            with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
                head = json.loads(str(file["head"]))
                traces = tuple(
                    Trace(
                        Level(**one["level"]),
                        tuple(one["energies"]),
                        one["sites"],
                        one["seconds"],
                        torch.from_numpy(file[f"texture{number}"]),
                    )
                    for number, one in enumerate(head["levels"])
                )
                field = label_field(file)
                randomness = torch.from_numpy(file["randomness"])
                labels = torch.from_numpy(file["labels"])
            return Checkpoint(head["seed"], head["settings"], randomness, traces, labels, field)
        except UNREADABLE as error:
            raise ValueError(
                f"checkpoint={path} is not a checkpoint ({error}); delete it or name another"
            ) from None
