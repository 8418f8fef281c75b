"""The label field: where every window of a texture came from, and how to render from it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtex.bands import BandField
from torchtex.image import atomic_write
from torchtex.label_spaces import LabelSpace, strips
from torchtex.neighborhoods import Grid, falloff
from torchtex.sources import UNREADABLE, SourceField, check_maps, unreadable


@dataclass(frozen=True)
class LabelField:
    """Source of every window of a texture, and its weight.

    Args:
        grid: windows of the texture.
        positions: (n, 3), exemplar, row and column of the first pixel of each matched window.
        weights: (n,), the robust weights of the windows in the average.
        shapes: height and width of each exemplar.

    Example:
        >>> grid = Grid(8, 8, 8, 8)
        >>> field = LabelField(grid, torch.tensor([[0, 2, 1]]), torch.ones(1), ((16, 16),))
        >>> field.apply(torch.rand(1, 16, 16)).shape
        torch.Size([1, 8, 8])
    """

    grid: Grid
    positions: Int[Tensor, "n 3"]
    weights: Float[Tensor, "n"]
    shapes: tuple[tuple[int, int], ...]

    @property
    def offsets(self) -> Int[Tensor, "ny nx 2"]:
        """Offset field: source position minus site, (row, column), per site."""
        ny, nx = self.grid.shape
        return (self.positions[:, 1:] - self.grid.sites.to(self.positions.device)).view(ny, nx, 2)

    def source_map(self) -> Int[Tensor, "h w 3"]:
        """Exemplar, row and column that weigh most in each pixel of the texture."""
        h, w, size = self.grid.height, self.grid.width, self.grid.size
        profile = falloff(size).to(self.weights)
        best = self.weights.new_full((h, w), -1)
        source = torch.zeros(h, w, 3, dtype=torch.long, device=self.positions.device)
        rows, cols = self.grid.rows, self.grid.cols
        place = self.positions.view(len(rows), len(cols), 3)
        weights = self.weights.view(len(rows), len(cols))
        for i in range(size):
            for j in range(size):
                # the windows of one offset touch distinct pixels, so this is one assignment
                at = ((rows + i) % h)[:, None], ((cols + j) % w)[None]
                here = weights * profile[i, j]
                wins = here > best[at]
                best[at] = torch.where(wins, here, best[at])
                step = torch.tensor([0, i, j], device=place.device)
                source[at] = torch.where(wins[..., None], place + step, source[at])
        return source

    def apply(
        self, maps: Float[Tensor, "k hz wz"] | Sequence[Float[Tensor, "k _ _"]]
    ) -> Float[Tensor, "k h w"]:
        """Renders maps aligned with the exemplars (normals, height, ...) with the same labels.

        Raises:
            ValueError: another number of maps than exemplars, or a map of another size.
        """
        images = [maps] if isinstance(maps, Tensor) else list(maps)
        check_maps(images, self.shapes)
        grid, size = self.grid, self.grid.size
        profile = falloff(size).to(images[0]).flatten()
        table = strips(images, LabelSpace(self.positions, ()), size)
        sums, cover = grid.zeros(images[0], len(images[0])), grid.zeros(images[0], 1)
        nx = grid.shape[1]
        every = torch.arange(len(self.positions), device=self.positions.device)
        for band in grid.bands(max(64, 2**20 // size**2)):
            some = every[band.start * nx : band.stop * nx]
            weights = self.weights[some].to(sums)[:, None] * profile
            patches = table.patches(some).view(len(some), size * size, -1)
            grid.scatter((patches * weights[..., None]).flatten(1), band, out=sums)
            grid.scatter(weights, band, out=cover)
        return (sums / cover).contiguous()

    def save(self, path: str | Path) -> None:
        """Writes an .npz file.

        Raises:
            ValueError: the file cannot be written.
        """
        with atomic_write(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, **label_arrays(self))

    @staticmethod
    def load(path: str | Path) -> "LabelField":
        """Reads a file that `save` wrote.

        Raises:
            ValueError: no such file, or another kind of file.
        """
        try:
            with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
                return label_field(file)
        except UNREADABLE as error:
            raise unreadable(path, error) from None


def label_arrays(field: LabelField) -> dict[str, Any]:
    """A label field as named numpy arrays, for a file.

    Example:
        >>> field = LabelField(Grid(8, 8, 8, 8), torch.zeros(1, 3).long(), torch.ones(1), ((9, 9),))
        >>> label_field(label_arrays(field)).shapes
        ((9, 9),)
    """
    grid = field.grid
    return {
        "grid": np.array([grid.height, grid.width, grid.size, grid.stride, int(grid.periodic)]),
        "positions": field.positions.cpu().numpy().astype(np.int32),
        "weights": field.weights.cpu().numpy(),
        "shapes": np.array(field.shapes),
    }


def label_field(arrays: Mapping[str, Any]) -> LabelField:
    """The label field that `label_arrays` took apart.

    Raises:
        ValueError, KeyError: the arrays are not those of a label field.
    """
    height, width, size, stride, periodic = (int(v) for v in arrays["grid"])
    grid = Grid(height, width, size, stride, bool(periodic))
    shapes = tuple((int(h), int(w)) for h, w in arrays["shapes"])
    positions = torch.from_numpy(arrays["positions"].astype(np.int64))
    weights = torch.from_numpy(arrays["weights"])
    if positions.shape != (len(grid), 3) or weights.shape != (len(grid),):
        raise ValueError("its labels do not fit its grid")
    which = positions[:, 0]
    if int(which.min()) < 0 or int(which.max()) >= len(shapes):
        raise ValueError("it names an exemplar that it does not have")
    room = torch.tensor(shapes)[which] - size
    if bool((positions[:, 1:] < 0).any()) or bool((positions[:, 1:] > room).any()):
        raise ValueError("its labels leave the exemplar")
    return LabelField(grid, positions, weights, shapes)


def load_field(path: str | Path) -> LabelField | SourceField:
    """Reads a label file of any recipe.

    Raises:
        ValueError: no such file, or another kind of file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            kinds = set(file.files)
    except UNREADABLE as error:
        raise unreadable(path, error) from None
    if "places" in kinds:
        return BandField.load(path)
    return SourceField.load(path) if "sources" in kinds else LabelField.load(path)
