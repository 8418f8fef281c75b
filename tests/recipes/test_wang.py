"""Wang tiles: colours, pixels across edges, files, tilings."""

import json
from pathlib import Path

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex import image as images
from torchtex.recipes.montage import Stage
from torchtex.recipes.tile_parts import Choice
from torchtex.recipes.wang import WangSet, edge_colors, edges_path, wang_tiles

QUICK = Choice(candidates=20, rounds=1, tries=1)
NORTH, EAST, SOUTH, WEST = range(4)


def made(exemplar: Tensor | None = None, tile: int = 16, **options: object) -> WangSet:
    exemplar = stripes(48, 52) if exemplar is None else exemplar
    return wang_tiles(exemplar, tile=tile, choice=QUICK, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("colors", "count", "whole"), [(2, 8, 16), (3, 18, 81)])
def test_colours(colors: int, count: int, whole: int) -> None:
    edges, every = edge_colors(colors), edge_colors(colors, complete=True)
    assert len({tuple(e) for e in edges.tolist()}) == len(edges) == count
    assert len({tuple(e) for e in every.tolist()}) == len(every) == whole
    pairs = [(e[NORTH], e[WEST]) for e in edges.tolist()]
    assert {pairs.count(p) for p in pairs} == {2}
    others = [(e[EAST], e[SOUTH]) for e in edges.tolist()]
    assert len({others.count(p) for p in others}) == 1
    assert len(set(others)) == colors**2


@pytest.mark.parametrize("cut", ["mincut", "dp"])
@pytest.mark.parametrize("colors", [2, 3])
def test_pixels_on_an_edge_are_those_of_its_patch(cut: str, colors: int) -> None:
    exemplar = noise(3, 48, 52)
    tiles = made(exemplar, colors=colors, cut=cut)
    side, reach = tiles.side, tiles.reach
    for tile, edges in zip(tiles.tiles, tiles.edges.tolist(), strict=True):
        for edge, line, part in (
            (NORTH, tile[:, 0], slice(0, side)),
            (SOUTH, tile[:, -1], slice(0, side)),
            (WEST, tile[:, :, 0], slice(1, side - 1)),  # corners are of the horizontal edges
            (EAST, tile[:, :, -1], slice(1, side - 1)),
        ):
            row, col = tiles.places[edge % 2, edges[edge]].tolist()
            at = reach if edge in (NORTH, WEST) else reach - 1  # this side of the middle
            if edge % 2 == 0:
                wanted = exemplar[:, row + at, col : col + side]
            else:
                wanted = exemplar[:, row : row + side, col + at]
            assert torch.equal(line[:, part], wanted[:, part])


@pytest.mark.parametrize("cut", ["mincut", "dp"])
def test_edges_match_everywhere_in_a_tiling(cut: str) -> None:
    exemplar = noise(1, 48, 52)
    tiles = made(exemplar, cut=cut)
    whole = tiles.tile((70, 90), seed=3)
    chosen = tiles._scan(5, 6, 3)
    edges = tiles.edges[chosen]
    assert torch.equal(edges[:-1, :, SOUTH], edges[1:, :, NORTH])
    assert torch.equal(edges[:, :-1, EAST], edges[:, 1:, WEST])
    assert torch.equal(whole.texture, tiles.lay(chosen).texture[:, :70, :90])
    # across an edge the exemplar goes on, pixel by pixel
    places, side = whole.source_map[..., 1:], tiles.side
    down, right = places[1:] - places[:-1], places[:, 1:] - places[:, :-1]
    assert (down[side - 1 :: side] == torch.tensor([1, 0])).all()
    inner = torch.tensor([i for i in range(70) if i % side not in (0, side - 1)])
    assert (right[inner][:, side - 1 :: side] == torch.tensor([0, 1])).all()
    # and the patch has one number on both sides
    patches = whole.patches
    assert torch.equal(patches[side - 1 : -1 : side], patches[side::side])
    assert torch.equal(patches[inner][:, side - 1 : -1 : side], patches[inner][:, side::side])


@pytest.mark.parametrize("channels", [1, 3, 4, 7])
def test_sources(channels: int) -> None:
    exemplar = noise(channels, 40, 44)
    tiles = made(exemplar, tile=12)
    assert torch.equal(tiles.sheet().apply(exemplar), tiles.atlas())
    whole = tiles.tile((50, 31))
    assert torch.equal(whole.apply(exemplar), whole.texture)
    assert whole.apply(noise(2, 40, 44)).shape == (2, 50, 31)
    assert tiles.atlas().shape == (channels, 24, 48)
    for number, tile in enumerate(tiles.tiles):
        assert torch.equal(tiles.lay(torch.tensor([[number]])).texture, tile)


def seams(tiles: WangSet) -> float:
    """Steps across all seams inside the tiles."""
    total = 0.0
    places = tiles.positions[..., 1:]
    for axis in (0, 1):
        n = tiles.side - 1
        a, b = (places.narrow(axis + 1, k, n) for k in (0, 1))
        x, y = (tiles.tiles.narrow(axis + 2, k, n) for k in (0, 1))
        cut = ((b - a) != torch.tensor([1 - axis, axis])).any(-1)
        total += float(((x - y).square().sum(1).sqrt() * cut).sum())
    return total


def test_a_longer_search_and_a_freer_cut_give_cheaper_seams() -> None:
    exemplar = images.resize(noise(3, 24, 24), (72, 72)).clamp(0, 1)
    best = Choice(candidates=60, rounds=2, tries=2)
    one = Choice(1, 1, 1)
    chosen, random = [], []
    for seed in range(3):
        chosen.append(seams(wang_tiles(exemplar, tile=24, choice=best, seed=seed)))
        random.append(seams(wang_tiles(exemplar, tile=24, choice=one, seed=seed)))
        paths = wang_tiles(exemplar, tile=24, choice=best, seed=seed, cut="dp")
        assert chosen[-1] < seams(paths)
    assert sum(chosen) < 0.9 * sum(random)


def test_colours_of_one_direction_are_different_patches() -> None:
    tiles = wang_tiles(stripes(64, 64), tile=16, choice=Choice(60, 2, 1))
    for places in tiles.places:
        assert (places[0] - places[1]).abs().max() >= 4


def test_masks_are_kept_to() -> None:
    mask = torch.zeros(48, 52, dtype=torch.bool)
    mask[:, 20:] = True
    tiles = made(mask=mask)
    assert tiles.positions[..., 2].min() >= 20
    mask[:, 25:] = False
    with pytest.raises(ValueError, match="mask leaves no place for a patch of 20x16"):
        made(mask=mask)


def test_seeds_and_threads() -> None:
    one, same, other = made(seed=1), made(seed=1), made(seed=2)
    assert torch.equal(one.atlas(), same.atlas())
    assert not torch.equal(one.places, other.places)
    assert torch.equal(one.tile((40, 40), 5).texture, same.tile((40, 40), 5).texture)
    assert not torch.equal(one.tile((40, 40), 5).texture, one.tile((40, 40), 6).texture)
    torch.set_num_threads(2)
    assert torch.equal(one.atlas(), made(seed=1).atlas())


def test_every_tile_is_used_about_as_often() -> None:
    for colors in (2, 3):
        tiles = made(colors=colors)
        count = torch.bincount(tiles._scan(60, 60, 0).flatten(), minlength=len(tiles.tiles))
        assert count.min() > 0.5 * count.float().mean()


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("channels", [1, 3])
def test_files(tmp_path: Path, bits: int, channels: int) -> None:
    exemplar = (noise(channels, 48, 52) * 255).round().float() / 255
    tiles = made(exemplar, complete=True)
    tiles.save(tmp_path / "a.png", bits=bits)  # type: ignore[arg-type]
    again = WangSet.load(tmp_path / "a.png")
    for name in ("edges", "pieces", "places"):
        assert torch.equal(getattr(again, name), getattr(tiles, name))
    assert (again.reach, again.shape, again.seed) == (tiles.reach, tiles.shape, tiles.seed)
    torch.testing.assert_close(again.tiles, tiles.tiles, atol=1e-6, rtol=0)
    whole = again.tile((33, 47), 9)
    assert torch.equal(whole.patches, tiles.tile((33, 47), 9).patches)
    torch.testing.assert_close(whole.apply(exemplar), whole.texture, atol=1e-6, rtol=0)


def test_steps_and_cancel() -> None:
    stages: list[Stage] = []
    made(on_step=stages.append)
    assert [s.note for s in stages] == ["choose patches"] + ["cut tiles"] * 8
    assert [s.done for s in stages] == sorted(s.done for s in stages)
    assert stages[-1].done == 1

    def stop(_: Stage) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        made(on_step=stop)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"colors": 4}, "colors=4 must be 2 or 3"),
        ({"tile": 15}, "tile=15 must be even"),
        ({"tile": 6}, "tile=6 must be even and at least 8"),
        ({"tile": 44}, r"tile=44 needs 54 pixels a side .* 48x52; choose tile=38 or less"),
        ({"cut": "graph"}, "cut='graph' is unknown"),
        ({"seed": -1}, r"seed=-1 must lie in 0\.\.2\^63 - 1"),
    ],
)
def test_refuses(unchecked: None, options: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        made(**options)  # type: ignore[arg-type]


def test_the_size_that_an_error_names_is_right(unchecked: None) -> None:
    assert len(made(tile=38).tiles) == 8
    with pytest.raises(ValueError, match=r"tile=8 needs 10 .* give a larger exemplar"):
        made(stripes(9, 9), tile=8)


def test_refuses_more(unchecked: None, tmp_path: Path) -> None:
    tiles = made()
    with pytest.raises(ValueError, match="size=0x4 must be"):
        tiles.tile((0, 4))
    with pytest.raises(ValueError, match="size=10000000x10000000 would need"):
        tiles.tile((10**7, 10**7))
    with pytest.raises(ValueError, match="seed=-3"):
        tiles.tile((4, 4), -3)
    with pytest.raises(ValueError, match="chosen must name"):
        tiles.lay(torch.tensor([[8]]))
    with pytest.raises(ValueError, match="atlas of 4 channels"):
        made(noise(4, 48, 52)).save(tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"must end in \.png"):
        tiles.save(tmp_path / "a.jpg")
    with pytest.raises(ValueError, match="candidates=0"):
        Choice(candidates=0)
    assert list(tmp_path.iterdir()) == []


def test_files_that_do_not_belong_together(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    with pytest.raises(ValueError, match="no such file"):
        WangSet.load(path)
    made().save(path)
    beside = edges_path(path)
    about = json.loads(beside.read_text())

    def refused(words: str) -> None:
        with pytest.raises(ValueError, match=words):
            WangSet.load(path)

    for text in ("no json", "[1]", "{}", json.dumps(about | {"format": "x"})):
        beside.write_text(text)
        refused("does not describe Wang tiles")
    for change in (
        {"tile": 32},
        {"tile": None},
        {"tile": 0},
        {"grid": [1, 2, 3]},
        {"pieces": "!"},
        {"pieces": about["pieces"][:8]},
        {"edges": [[0, 0, 0, 0]] * 8},
        {"edges": [[0, 0, 0, 5]] * 8},
        {"edges": "abc"},
        {"exemplar": [9, 9]},
        {"places": [[0, 1]]},
        {"seed": "x"},
        {"settings": 3},
    ):
        beside.write_text(json.dumps(about | change))
        refused(r"'a\.json' is damaged")
    missing = {k: v for k, v in about.items() if k != "edges"}
    beside.write_text(json.dumps(missing))
    refused("is damaged")
    beside.write_text(json.dumps(about))
    WangSet.load(path)
    images.save(path, torch.zeros(3, 32, 64))
    refused("does not have the pixels")
    beside.unlink()
    refused(r"needs 'a\.json' beside it")
