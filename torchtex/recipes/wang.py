"""Wang tiles: a small set of square tiles whose edges have colours, laid side by side at random.

Every edge colour is a patch of the exemplar with the edge through its middle, horizontal edges
and vertical ones apart. A tile shows, inside each of its edges, that colour's patch, and seams
are cut between the four: so across an edge two tiles continue one patch, whatever the tiles.

Only at a corner do four patches meet in a point that no seam can avoid, and when they differ much
it is seen: patches are therefore chosen, out of many random ones, for cheap seams among them.
"""

import base64
import hashlib
import json
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex import image as images
from torchtex.cuts.mincut import MinCut
from torchtex.image import check_image
from torchtex.inputs import check_seed, check_size, memory_of
from torchtex.patches import box_sums, summed_area
from torchtex.recipes.montage import Montage, Stage
from torchtex.recipes.tile_parts import (
    EAST,
    NORTH,
    SOUTH,
    WEST,
    Assembly,
    Choice,
    PatchSearch,
    extents,
    shift,
)
from torchtex.sources import SourceField, copied

FORMAT = "torchtex wang tiles 1"


@dataclass(frozen=True)
class WangSet:
    """Tiles, and all that is needed to lay them.

    Args:
        tiles: (n, c, s, s) in [0, 1].
        edges: (n, 4), colours to the north, east, south and west.
        pieces: (n, s, s), the edge, in that order, whose patch each pixel shows.
        places: (2, colors, 2), where in the exemplar the patches of the horizontal edges and
            those of the vertical ones have their first pixel.
        reach: pixels of a patch on either side of its edge.
        shape: height and width of the exemplar.
        seed: that the set was made with.
        seconds: that it took.
        settings: plain values that describe the run.

    Raises:
        ValueError: numbers that do not fit together, or a set that cannot tile the plane.
    """

    tiles: Float[Tensor, "n c s s"]
    edges: Int[Tensor, "n 4"]
    pieces: Int[Tensor, "n s s"]
    places: Int[Tensor, "2 k 2"]
    reach: int
    shape: tuple[int, int]
    seed: int
    seconds: float
    settings: Mapping[str, Any]

    def __post_init__(self) -> None:
        n, side, colors = len(self.tiles), self.tiles.shape[-1], self.places.shape[1]
        if self.edges.shape != (n, 4) or self.pieces.shape != (n, side, side):
            raise ValueError(f"edges or pieces are not those of {n} tiles of {side} px")
        for name, value, most in (("edges", self.edges, colors), ("pieces", self.pieces, 4)):
            if int(value.min()) < 0 or int(value.max()) >= most:
                raise ValueError(f"{name} must lie in 0..{most - 1}")
        if len(set(map(tuple, self.edges[:, [NORTH, WEST]].tolist()))) < colors**2:
            raise ValueError("edges leave pairs of colours to the north and west without a tile")
        room = torch.tensor(self.shape, device=self.places.device)
        for extent, places in zip(extents(side, self.reach), self.places, strict=True):
            last = places + torch.tensor(extent, device=places.device)
            if bool((places < 0).any()) or bool((last > room).any()):
                raise ValueError("places leave the exemplar")

    @property
    def side(self) -> int:
        """Pixels along the edge of a tile."""
        return self.tiles.shape[-1]

    @property
    def colors(self) -> int:
        """Colours of the horizontal edges, and of the vertical ones."""
        return self.places.shape[1]

    @property
    def positions(self) -> Int[Tensor, "n s s 3"]:
        """Exemplar (always 0), row and column of every pixel."""
        n, side = len(self.tiles), self.side
        shifts = torch.tensor(
            [
                [shift(edge, self.places, int(color), side, self.reach) for edge, color in row]
                for row in (list(enumerate(colors)) for colors in self.edges.tolist())
            ],
            device=self.pieces.device,
        )
        own = shifts.gather(1, self.pieces.view(n, -1, 1).expand(-1, -1, 2)).view(n, side, side, 2)
        line = torch.arange(side, device=self.pieces.device)
        grid = torch.stack(torch.meshgrid(line, line, indexing="ij"), -1)
        return torch.cat([torch.zeros_like(own[..., :1]), own + grid], -1)

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of the atlas."""
        n = len(self.tiles)
        rows = next(r for r in range(int(n**0.5), 0, -1) if n % r == 0)
        return rows, n // rows

    def atlas(self) -> Float[Tensor, "c h w"]:
        """All tiles in one image, row by row.

        Example:
            >>> wang_tiles(torch.rand(3, 32, 32), tile=16).atlas().shape
            torch.Size([3, 32, 64])
        """
        return self.sheet().texture

    def sheet(self) -> Montage:
        """The atlas, and where its pixels came from.

        Example:
            >>> wang_tiles(torch.rand(3, 32, 32), tile=16).sheet().source_map.shape
            torch.Size([32, 64, 3])
        """
        return self.lay(torch.arange(len(self.tiles)).view(self.grid))

    def lay(self, chosen: Int[Tensor, "rows cols"]) -> Montage:
        """Tiles side by side, by their numbers; nothing is asked of their edges.

        Raises:
            ValueError: a number that no tile has.

        Example:
            >>> tiles = wang_tiles(torch.rand(1, 32, 32), tile=16)
            >>> tiles.lay(torch.tensor([[0, 1, 2]])).texture.shape
            torch.Size([1, 16, 48])
        """
        if int(chosen.min()) < 0 or int(chosen.max()) >= len(self.tiles):
            raise ValueError(f"chosen must name tiles in 0..{len(self.tiles) - 1}")
        rows, cols = chosen.shape
        chosen = chosen.to(self.edges.device)
        joined = self.tiles[chosen].permute(2, 0, 3, 1, 4).flatten(3).flatten(1, 2)
        places = self.positions[chosen].transpose(1, 2).flatten(2, 3).flatten(0, 1)
        # the patch on an edge has a number of its own, the same in both tiles
        at = torch.arange(rows * cols, device=chosen.device).view(rows, cols)
        upright = (rows + 1) * cols + at + at // cols
        owners = torch.stack([at, upright + 1, at + cols, upright], -1)
        pieces = self.pieces[chosen].flatten(2)
        owner = owners.gather(2, pieces).view(rows, cols, self.side, self.side)
        patches = owner.transpose(1, 2).flatten(2, 3).flatten(0, 1)
        return Montage(
            joined, copied(places, (self.shape,)), patches, self.seconds, self.seed, self.settings
        )

    def tile(self, size: tuple[int, int], seed: int = 0) -> Montage:
        """A texture of any size: row by row, a random tile of those that fit to the left and above.

        Raises:
            ValueError: a size below 1 or beyond what memory may hold, or a seed out of range.

        Example:
            >>> tiles = wang_tiles(torch.rand(3, 32, 32), tile=16)
            >>> tiles.tile((40, 70), seed=1).texture.shape
            torch.Size([3, 40, 70])
        """
        begin = time.perf_counter()
        check_seed(seed)
        height, width = size
        check_size(size, memory_of(self.tiles[0], size, images=4, numbers=24))
        whole = self.lay(self._scan(-(-height // self.side), -(-width // self.side), seed))
        field = whole.field
        return Montage(
            whole.texture[:, :height, :width].contiguous(),
            SourceField(
                field.positions[:, :height, :width].contiguous(),
                field.weights[:, :height, :width].contiguous(),
                field.shapes,
            ),
            whole.patches[:height, :width].contiguous(),
            time.perf_counter() - begin,
            seed,
            {**self.settings, "size": [height, width], "set_seed": self.seed},
        )

    def _scan(self, rows: int, cols: int, seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        fitting: dict[tuple[int, int], list[int]] = {}
        edges = self.edges.tolist()
        for number, colors in enumerate(edges):
            fitting.setdefault((colors[NORTH], colors[WEST]), []).append(number)
        north = torch.randint(self.colors, (cols,), generator=generator).tolist()
        first = torch.randint(self.colors, (rows,), generator=generator).tolist()
        draws = torch.rand(rows, cols, generator=generator, dtype=torch.float64).tolist()
        chosen = []
        for west, draw in zip(first, draws, strict=True):
            for col, share in enumerate(draw):
                among = fitting[north[col], west]
                number = among[int(share * len(among))]
                north[col], west = edges[number][SOUTH], edges[number][EAST]
                chosen.append(number)
        return torch.tensor(chosen).view(rows, cols)

    def save(self, path: str | Path, *, bits: Literal[8, 16] = 8) -> None:
        """Writes the atlas as a PNG, and the rest as JSON beside it.

        Raises:
            ValueError: a name that does not end in .png, files that cannot be written, or a set
                of other than 1 or 3 channels.

        Example:
            >>> import tempfile
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     wang_tiles(torch.rand(3, 32, 32), tile=16).save(f"{folder}/atlas.png")
            ...     WangSet.load(f"{folder}/atlas.png").colors
            2
        """
        images.check_writable(path, suffixes=(".png",), name="atlas")
        if self.tiles.shape[1] not in (1, 3):
            raise ValueError(f"atlas of {self.tiles.shape[1]} channels; a PNG holds 1 or 3 here")
        images.save(path, self.atlas(), bits=bits, name="atlas")
        self.save_edges(path, bits=bits)

    def save_edges(self, path: str | Path, *, bits: int = 8) -> None:
        """Writes the JSON alone, beside an atlas that is there already."""
        held = (self.atlas() * (2**bits - 1)).round() / (2**bits - 1)
        about = {
            "format": FORMAT,
            "tile": self.side,
            "reach": self.reach,
            "grid": list(self.grid),
            "edges": self.edges.tolist(),
            "places": self.places.tolist(),
            "exemplar": list(self.shape),
            "pieces": base64.b64encode(
                zlib.compress(self.pieces.to(torch.uint8).cpu().numpy().tobytes(), 9)
            ).decode(),
            "pixels": _digest(held),
            "seed": self.seed,
            "seconds": self.seconds,
            "settings": dict(self.settings),
        }
        with images.atomic_write(edges_path(path), name="edges") as temporary:
            temporary.write_text(json.dumps(about) + "\n")

    @staticmethod
    def load(path: str | Path) -> "WangSet":
        """Reads what `save` wrote.

        Raises:
            ValueError: a file is missing, or is none of ours, or the two do not belong together.
        """
        atlas = images.load(path, alpha=False, name="atlas").image
        beside = edges_path(path)
        try:
            about = json.loads(beside.read_text(encoding="utf-8"))
        except OSError as error:
            raise ValueError(
                f"atlas={str(path)!r} needs {beside.name!r} beside it, which cannot be read "
                f"({error.strerror or error}); keep the two together"
            ) from None
        except ValueError:
            about = None
        if not isinstance(about, dict) or about.get("format") != FORMAT:
            raise ValueError(
                f"atlas={str(path)!r}: {beside.name!r} does not describe Wang tiles; "
                "give an atlas that torchtex wrote"
            )
        if about.get("pixels") != _digest(atlas):
            raise ValueError(
                f"atlas={str(path)!r} does not have the pixels that {beside.name!r} describes; "
                "give the two that were written together"
            )
        try:
            return _read(atlas, about)
        except (KeyError, TypeError, ValueError, RuntimeError, zlib.error) as error:
            raise ValueError(
                f"atlas={str(path)!r}: {beside.name!r} is damaged ({error}); write the set anew"
            ) from None


def wang_tiles(
    exemplar: Float[Tensor, "c hz wz"],
    *,
    colors: int = 2,
    tile: int = 64,
    complete: bool = False,
    cut: Literal["mincut", "dp"] = "mincut",
    solver: MinCut | None = None,
    choice: Choice | None = None,
    mask: Bool[Tensor, "hz wz"] | None = None,
    seed: int = 0,
    on_step: Callable[[Stage], None] | None = None,
) -> WangSet:
    """A set of Wang tiles cut from an exemplar.

    Args:
        colors: 2 or 3, of horizontal edges, and as many of vertical ones.
        tile: side of a tile in pixels, even and at least 8; 5/4 of it must fit in the exemplar.
        complete: all colors^4 tiles (16 or 81); else two (8 or 18 in all) for every pair of
            colours to the north and west, the fewest that leave a choice.
        cut: "mincut" cuts freely between the four patches, "dp" along four paths from the corners
            to the centre.
        solver: of "mincut"; None for the first one that is installed.
        choice: how hard to look for patches that fit together; None for `Choice()`.
        mask: True where the exemplar may be used.
        seed: of the patches tried.

    Raises:
        ValueError: a tile too large for the exemplar or its mask, or an option out of range.

    Source: Cohen et al. 2003, Wang Tiles for Image and Texture Generation, sections 3 and 4.

    Example:
        >>> tiles = wang_tiles(torch.rand(3, 40, 40), tile=16, choice=Choice(tries=1))
        >>> len(tiles.tiles), tiles.edges[0].tolist()
        (8, [0, 0, 0, 0])
    """
    begin = time.perf_counter()
    choice = Choice() if choice is None else choice
    check_image(exemplar, "exemplar")
    reach = _check(exemplar, colors, tile, cut, seed)
    allowed = [_allowed(exemplar, mask, extent) for extent in extents(tile, reach)]
    generator = torch.Generator().manual_seed(seed)
    places = PatchSearch(exemplar, tile, reach, allowed, colors, generator).chosen(choice, on_step)
    edges = edge_colors(colors, complete=complete)
    assemble = Assembly(exemplar, places, tile, reach, cut, solver)
    pieces = []
    for number, row in enumerate(edges.tolist()):
        pieces.append(assemble(row))
        if on_step is not None:
            done = (1 + (number + 1) / len(edges)) / 2
            shown = assemble.pixels(row, pieces[-1])
            on_step(Stage(done, "cut tiles", shown, f"{number + 1} of {len(edges)}"))
    settings = {
        "recipe": "wang",
        "colors": colors,
        "tile": tile,
        "complete": complete,
        "cut": cut,
        "choice": [choice.candidates, choice.rounds, choice.tries],
    }
    tiles = torch.stack(
        [assemble.pixels(r, p) for r, p in zip(edges.tolist(), pieces, strict=True)]
    )
    return WangSet(
        tiles, edges.to(exemplar.device), torch.stack(pieces), places, reach,
        (exemplar.shape[1], exemplar.shape[2]), seed, time.perf_counter() - begin, settings,
    )  # fmt: skip


def edge_colors(colors: int, *, complete: bool = False) -> Int[Tensor, "n 4"]:
    """Colours to the north, east, south and west of every tile of a set.

    The compact set has two tiles for each pair to the north and west; all pairs to the east and
    south are as frequent as each other, so no colour dies out.

    Example:
        >>> edge_colors(2).shape, edge_colors(3, complete=True).shape
        (torch.Size([8, 4]), torch.Size([81, 4]))
    """
    every = range(colors)
    if complete:
        return torch.tensor(list(product(every, repeat=4)))
    return torch.tensor(
        [
            (n, (n + turn) % colors, (w + turn) % colors, w)
            for n, w, turn in product(every, every, range(2))
        ]
    )


def edges_path(atlas: str | Path) -> Path:
    """The JSON file that belongs to an atlas.

    Example:
        >>> edges_path("moss.png").name
        'moss.json'
    """
    return Path(atlas).with_suffix(".json")


def _check(exemplar: Tensor, colors: int, tile: int, cut: str, seed: int) -> int:
    if colors not in (2, 3):
        raise ValueError(f"colors={colors} must be 2 or 3")
    if cut not in ("mincut", "dp"):
        raise ValueError(f"cut={cut!r} is unknown; choose mincut or dp")
    if tile < 8 or tile % 2:
        raise ValueError(f"tile={tile} must be even and at least 8")
    check_seed(seed)
    reach = tile // 2 + max(1, tile // 8)
    shortest = min(exemplar.shape[1:])
    if 2 * reach > shortest:
        fits = next(
            (t for t in range(shortest & ~1, 6, -2) if t + 2 * max(1, t // 8) <= shortest), 0
        )
        remedy = f"choose tile={fits} or less" if fits else "give a larger exemplar"
        raise ValueError(
            f"tile={tile} needs {2 * reach} pixels a side and the exemplar has "
            f"{exemplar.shape[1]}x{exemplar.shape[2]}; {remedy}"
        )
    return reach


def _allowed(exemplar: Tensor, mask: Tensor | None, extent: tuple[int, int]) -> Tensor:
    """Places (m, 2) where a patch fits in the exemplar, and in its mask."""
    usable = torch.ones_like(exemplar[0]) if mask is None else mask.to(exemplar)
    full = box_sums(summed_area(usable), *extent) > extent[0] * extent[1] - 0.5
    if not bool(full.any()):
        raise ValueError(
            f"mask leaves no place for a patch of {extent[0]}x{extent[1]} pixels; "
            "widen it or choose a smaller tile"
        )
    return full.nonzero()


def _digest(atlas: Tensor) -> str:
    values = (atlas.detach().cpu().double() * 65535).round().long().numpy()
    return hashlib.sha256(values.astype("<u2").tobytes()).hexdigest()


def _read(atlas: Tensor, about: Mapping[str, Any]) -> WangSet:
    side, (rows, cols) = int(about["tile"]), about["grid"]
    if tuple(atlas.shape[1:]) != (rows * side, cols * side):
        raise ValueError(f"the atlas is not {rows}x{cols} tiles of {side} px")
    tiles = atlas.view(len(atlas), rows, side, cols, side).permute(1, 3, 0, 2, 4).flatten(0, 1)
    pieces = torch.frombuffer(
        bytearray(zlib.decompress(base64.b64decode(about["pieces"], validate=True))),
        dtype=torch.uint8,
    )
    height, width = about["exemplar"]
    return WangSet(
        tiles.contiguous(),
        torch.tensor(about["edges"], dtype=torch.long),
        pieces.long().view(len(tiles), side, side),
        torch.tensor(about["places"], dtype=torch.long),
        int(about["reach"]),
        (int(height), int(width)),
        int(about["seed"]),
        float(about["seconds"]),
        dict(about["settings"]),
    )
