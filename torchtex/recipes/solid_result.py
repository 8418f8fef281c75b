"""What making a solid returns: the volume with its sources, progress on the way, checkpoints."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex import image as images
from torchtex.codecs import reason
from torchtex.schedule import Level
from torchtex.sources import UNREADABLE, check_maps
from torchtex.volumes.files import save_volume
from torchtex.volumes.slices import diagonal_slice, slices_of, tiled


@dataclass(frozen=True)
class SolidStep:
    """What `on_step` is given after each half-step.

    Args:
        done: share of the work that is done, in [0, 1], by an estimate.
        note: what goes on, in a few words.
        detail: the energy, as text.
        volume: a preview, (c, d, h, w) at the scale of the level.
    """

    done: float
    note: str
    detail: str
    volume: Float[Tensor, "c d h w"]

    @property
    def texture(self) -> Float[Tensor, "c h w"]:
        """The slice in the middle."""
        return self.volume[:, self.volume.shape[1] // 2]


@dataclass(frozen=True)
class SolidTrace:
    """Record of one level: its settings, energy per window after each half-step, seconds."""

    level: Level
    energies: tuple[float, ...]
    windows: int
    seconds: float


@dataclass(frozen=True)
class Solid:
    """A volume of texture, where every voxel came from, and how it was made.

    It tiles: what leaves it on one side enters on the other.

    Args:
        volume: (c, d, h, w) in [0, 1].
        sources: exemplar, row and column of every voxel, as 16-bit numbers.
        shapes: height and width of each exemplar.
        traces: one per level.
        seconds: of the whole run.
        seed: of the run.
        settings: plain values that describe the run.

    Example:
        >>> sources = torch.zeros(2, 2, 2, 3, dtype=torch.int16)
        >>> whole = Solid(torch.ones(1, 2, 2, 2), sources, ((8, 8),), (), 0.1, 0, {})
        >>> whole.apply(torch.ones(4, 8, 8)).shape
        torch.Size([4, 2, 2, 2])
    """

    volume: Float[Tensor, "c d h w"]
    sources: Int[Tensor, "d h w 3"]
    shapes: tuple[tuple[int, int], ...]
    traces: tuple[SolidTrace, ...]
    seconds: float
    seed: int
    settings: Mapping[str, Any]

    @property
    def energies(self) -> tuple[float, ...]:
        """Energy per window after each step, all levels in order."""
        return tuple(energy for trace in self.traces for energy in trace.energies)

    def apply(
        self, maps: Float[Tensor, "k _ _"] | Sequence[Float[Tensor, "k _ _"]]
    ) -> Float[Tensor, "k d h w"]:
        """A volume of maps aligned with the exemplars (height, gloss, ...), from the same places.

        Raises:
            ValueError: another number of maps than exemplars, or a map of another size.
        """
        layers = [maps] if isinstance(maps, Tensor) else list(maps)
        check_maps(layers, self.shapes)
        which, row, col = self.sources.long().unbind(-1)
        whole = layers[0].new_zeros(len(layers[0]), *which.shape)
        for number, layer in enumerate(layers):
            here = which == number
            whole[:, here] = layer[:, row[here], col[here]]
        return whole

    def tiled(self, size: tuple[int, int, int]) -> Float[Tensor, "c d2 h2 w2"]:
        """A volume of another size, such as 256 x 256 x 256, filled with copies of this one."""
        return tiled(self.volume, size)

    def save(self, path: str | Path, *, bits: int = 8) -> None:
        """Writes the volume: .npy, .nrrd, .vti, .zarr, or a folder of slices without an ending."""
        save_volume(path, self.volume, bits=bits)

    def report(self) -> dict[str, Any]:
        """Settings, seed, timings and energies as plain values."""
        return {
            "seed": self.seed,
            "seconds": self.seconds,
            "settings": dict(self.settings),
            "levels": [asdict(trace) | asdict(trace.level) for trace in self.traces],
        }

    def sheet(self) -> Float[Tensor, "c y x"]:
        """Slices from the front, from above, from the side and along a diagonal, in a row."""
        d, h, w = self.volume.shape[1:]
        cut = [slices_of(self.volume, axis)[n // 2] for axis, n in enumerate((d, h, w))]
        cut.append(diagonal_slice(self.volume))
        tall = max(picture.shape[1] for picture in cut)
        framed = [torch.nn.functional.pad(p, (0, 4, 0, tall - p.shape[1]), value=1.0) for p in cut]
        return torch.cat(framed, 2)[:, :, :-4]


@dataclass(frozen=True)
class SolidCheckpoint:
    """All that a run needs to go on after the levels that are done.

    Args:
        seed, settings: of the run.
        randomness: state of its generator.
        traces: one per level that is done.
        pixel: of every voxel, in the table of all exemplars at the scale of the last level.
        axis: of the slice that it came from.
        file: that it was read from, for errors to name.
    """

    seed: int
    settings: Mapping[str, Any]
    randomness: Tensor
    traces: tuple[SolidTrace, ...] = ()
    pixel: Int[Tensor, "d h w"] | None = None
    axis: Int[Tensor, "d h w"] | None = None
    file: str | None = None

    def checked(self, seed: int, settings: Mapping[str, Any]) -> "SolidCheckpoint":
        """This checkpoint, for a run with the given settings.

        Raises:
            ValueError: it is of a run with another seed or other settings.
        """
        mine = json.loads(json.dumps({**self.settings, "seed": self.seed}))
        theirs = json.loads(json.dumps({**settings, "seed": seed}))
        differ = [name for name in theirs if mine.get(name) != theirs[name]]
        if differ or self.pixel is None:
            name = differ[0] if differ else "levels"
            what, remedy = "resume: the checkpoint", "begin anew"
            if self.file is not None:
                what, remedy = f"checkpoint={self.file!r}", "delete it"
            raise ValueError(
                f"{what} is of a run with {name}={mine.get(name)} and this one has "
                f"{name}={theirs.get(name)}; give the same options, or {remedy}"
            )
        return self

    def save(self, path: str | Path) -> None:
        """Writes an .npz file.

        Raises:
            ValueError: the file cannot be written, or no level is done.
        """
        if self.pixel is None or self.axis is None:
            raise ValueError("checkpoint: no level is done; save one that on_level was given")
        head = {
            "seed": self.seed,
            "settings": dict(self.settings),
            "traces": [asdict(trace) for trace in self.traces],
        }
        with images.atomic_write(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                solid=np.array(json.dumps(head)),
                randomness=self.randomness.numpy(),
                pixel=self.pixel.cpu().numpy().astype(np.int32),
                axis=self.axis.cpu().numpy().astype(np.uint8),
            )

    @staticmethod
    def load(path: str | Path) -> "SolidCheckpoint":
        """Reads a file that `save` wrote.

        Raises:
            ValueError: no such file, or another kind of file.
        """
        try:
            with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
                head = json.loads(str(file["solid"]))
                traces = tuple(
                    SolidTrace(
                        Level(**one["level"]), tuple(one["energies"]), one["windows"],
                        one["seconds"],
                    )
                    for one in head["traces"]
                )  # fmt: skip
                randomness = torch.from_numpy(file["randomness"])
                pixel = torch.from_numpy(file["pixel"]).long()
                axis = torch.from_numpy(file["axis"]).long()
            return SolidCheckpoint(
                head["seed"], head["settings"], randomness, traces, pixel, axis, str(path)
            )
        except UNREADABLE as error:
            why = f" ({reason(error)})" if isinstance(error, OSError) else ""
            raise ValueError(
                f"checkpoint={str(path)!r} is not a checkpoint of a solid{why}; delete it or name "
                "another"
            ) from None
