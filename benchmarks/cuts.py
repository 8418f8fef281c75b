"""Min-cut, seams and expansion moves: seconds and costs, as JSON and a table.

Sections:

- `mincut`: grids of 128 to 512 pixels a side; our layer against the bare calls of PyMaxflow on
  ready float64 arrays (nodes, terminal edges, `add_edges`, maxflow, segments), and OR-Tools.
  `denoise` has costs everywhere and short paths; `seam` has two fixed regions and long ones.
- `patch`: one placement of a 128 x 128 patch on a canvas of many patches (`cut_patch`).
- `quilt`: cost of the seam of one min-cut over that of two dynamic-programming paths, by the
  colour differences that the cut minimises (the paths minimise squared ones, pixel by pixel).
- `expansion`: alpha-expansion on 64 x 64 nodes and 20 labels.

Rivals take turns in one process. Times are CPU milliseconds of one thread, median and spread of
the repeats; overheads compare the least times, which bear a busy machine best.
"""

import argparse
import ctypes
import platform
import statistics
import time
from pathlib import Path

import maxflow
import numpy as np
import torch
import torch.nn.functional as F
from common import add_arguments, environment, measured, photos_of
from exemplars import crop

from torchtex.cuts.expansion import Potts, Table, every_label, expand
from torchtex.cuts.mincut import OrTools, PyMaxflow, cut_energy, cut_grid, grid_edges
from torchtex.cuts.paths import quilt_cut, quilt_mask
from torchtex.cuts.seams import cut_patch, patch_views, present_seams, seam_costs

TARGET = {"overhead": 0.15, "patch_ms": 20}


def in_turn(works, repeats):
    """Median, least and most CPU milliseconds of each call; they take turns after a warm-up."""
    spent = {name: [] for name in works}
    for turn in range(repeats + 1):
        for name, work in works.items():
            start = time.process_time()
            work()
            if turn:
                spent[name].append(1e3 * (time.process_time() - start))
    return {
        name: {"median": statistics.median(ms), "least": min(ms), "most": max(ms)}
        for name, ms in spent.items()
    }


def keep_memory():
    """Freed memory stays with the process: page faults would be charged to whoever comes next."""
    if platform.libc_ver()[0] == "glibc":
        trim_threshold, mmap_max = -1, -4
        libc = ctypes.CDLL(None)
        libc.mallopt(trim_threshold, 2**30)
        libc.mallopt(mmap_max, 0)


def smooth_noise(side, seed, channels=1):
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(channels, side, side, generator=generator, dtype=torch.float64)
    image = F.avg_pool2d(image[None], 5, 1, 2, count_include_pad=False)[0]
    return 0.5 + 0.2 * (image - image.mean()) / image.std()


def denoise(side):
    """Two noisy regions: costs of both labels everywhere, capacities of one size."""
    field = smooth_noise(side, 0)[0] - 0.5
    grain = torch.rand(side, side, generator=torch.Generator().manual_seed(1)).double() - 0.5
    unary = torch.stack([(field + grain).clamp_min(0), (-field - grain).clamp_min(0)], -1)
    even = torch.full((side, side, 2), 0.15, dtype=torch.float64)
    return unary, even[:, :-1].contiguous(), even[:-1].contiguous()


def seam(side):
    """A patch in the middle and the old canvas at the border; the seam runs between."""
    costs = seam_costs(smooth_noise(side, 2, 3), smooth_noise(side, 3, 3))
    right, down = (c[..., None].expand(-1, -1, 2).contiguous() for c in costs)
    unary = torch.zeros(side, side, 2, dtype=torch.float64)
    unary[0, :, 1] = unary[-1, :, 1] = unary[:, 0, 1] = unary[:, -1, 1] = torch.inf
    middle = slice(side // 3, 2 * side // 3)
    unary[middle, middle, 0] = torch.inf
    return unary, right, down


def bare(unary, right, down):
    """PyMaxflow alone on arrays that are ready; returns the labels."""
    h, w, _ = unary.shape
    graph = maxflow.GraphFloat(h * w, right.size // 2 + down.size // 2)
    nodes = graph.add_grid_nodes((h, w))
    graph.add_grid_tedges(nodes, unary[..., 1], unary[..., 0])
    for tail, head, both in (
        (nodes[:, :-1], nodes[:, 1:], right),
        (nodes[:-1], nodes[1:], down),
    ):
        flat = both.reshape(-1, 2)
        graph.add_edges(tail.ravel(), head.ravel(), flat[:, 0], flat[:, 1])
    graph.maxflow()
    return graph.get_grid_segments(nodes)


def mincut(repeats):
    rows = []
    for kind in (denoise, seam):
        for side in (128, 256, 512):
            unary, right, down = kind(side)
            big = float(right.sum() + down.sum() + 1)
            ready = [x.numpy() for x in (unary.nan_to_num(posinf=big), right, down)]
            single = [x.float() for x in (unary, right, down)]
            edges = grid_edges(side, side, side - 1, side - 1)
            flat = unary.flatten(0, 1), edges, torch.cat([right.flatten(0, 1), down.flatten(0, 1)])
            ours, other = PyMaxflow(), OrTools()
            works = {
                "bare": lambda r=ready: bare(*r),
                "grid": lambda p=(unary, right, down), s=ours: cut_grid(*p, s),
                "grid32": lambda p=single, s=ours: cut_grid(*p, s),
                "edges": lambda p=flat, s=ours: s(*p),
            }
            row = {"kind": kind.__name__, "side": side}
            row["ms"] = in_turn(works, repeats * 512 // side)
            few = max(1, repeats // 4)
            works = {"ortools": lambda p=(unary, right, down), s=other: cut_grid(*p, s)}
            row["ms"] |= in_turn(works, few)
            labels = cut_grid(unary, right, down, ours)
            assert np.array_equal(labels.numpy(), bare(*ready))
            costs = [
                float(cut_energy(x.flatten(), *flat))
                for x in (labels, cut_grid(unary, right, down, other))
            ]
            row["cost"], row["ortools_excess"] = costs[0], costs[1] / costs[0] - 1
            for name in ("grid", "grid32", "edges", "ortools"):
                row[name] = row["ms"][name]["least"] / row["ms"]["bare"]["least"] - 1
            rows.append(row)
            print(
                f"mincut {kind.__name__} {side}: bare {row['ms']['bare']['least']:.1f} ms, grid "
                f"{100 * row['grid']:+.1f} %, float32 {100 * row['grid32']:+.1f} %, edges "
                f"{100 * row['edges']:+.1f} %, OR-Tools {1 + row['ortools']:.1f}x",
                flush=True,
            )
    return rows


def patch(photos, repeats):
    """Placements on a canvas that earlier placements have filled."""
    side, rows = 128, []
    for name, photo in photos.items():
        views = patch_views(crop(photo, 256))
        room = [extent - side + 1 for extent in views.shape[2:]]
        if min(room) < 2:
            continue
        generator = torch.Generator().manual_seed(0)

        def draw(views=views, room=room, generator=generator):
            i, j = (int(torch.randint(n, (1,), generator=generator)) for n in room)
            return views[..., i : i + side, j : j + side]

        border = torch.ones(side, side, dtype=torch.bool)
        border[1:-1, 1:-1] = False
        canvas, middle = draw().clone(), torch.zeros_like(border)
        for _ in range(12):
            middle[:] = False
            i, j = (int(v) for v in torch.randint(8, side - 40, (2,), generator=generator))
            middle[i : i + 32, j : j + 32] = True
            new = draw()
            canvas = torch.where(cut_patch(canvas, new, border, middle), new, canvas)
        new = draw()
        placed = (canvas, new, border, middle)
        works = {}
        for key, solver in (("pymaxflow", PyMaxflow()), ("ortools", OrTools())):
            works[key] = lambda p=placed, s=solver: cut_patch(*p, solver=s)
            works[f"{key} gradient"] = lambda p=placed, s=solver: cut_patch(
                *p, gradient=True, solver=s
            )
        rows.append({"exemplar": name, "ms": in_turn(works, repeats)})
        medians = {key: round(ms["median"], 1) for key, ms in rows[-1]["ms"].items()}
        print(f"patch {name}: {medians}", flush=True)
    return rows


def quilt(photos, repeats):
    """Seam cost in the L-shaped overlap of blocks that were chosen at random."""
    rows = []
    for name, photo in photos.items():
        views, size, width = patch_views(crop(photo, 192)), 48, 12
        room = [extent - size + 1 for extent in views.shape[2:]]
        generator = torch.Generator().manual_seed(0)
        ratios = []
        for _ in range(20):
            at = [[int(torch.randint(n, (1,), generator=generator)) for n in room] for _ in "on"]
            old, new = (views[..., i : i + size, j : j + size] for i, j in at)
            masks = quilt_cut(old, new, width, width), quilt_mask(old[0], new[0], width, width)
            seams = [present_seams(torch.where(mask, new, old)) for mask in masks]
            cut, path = (float(right.sum() + down.sum()) for right, down in seams)
            ratios.append(cut / path)
        works = {
            "paths": lambda o=old, n=new, w=width: quilt_mask(o[0], n[0], w, w),
            "cut": lambda o=old, n=new, w=width: quilt_cut(o, n, w, w),
        }
        row = {"exemplar": name, "ratio": statistics.median(ratios), "ms": in_turn(works, repeats)}
        rows.append(row)
        print(f"quilt {name}: the cut costs {100 * row['ratio']:.0f} % of the paths", flush=True)
    return rows


def expansion(repeats):
    side, count = 64, 20
    levels = torch.linspace(0, 1, count, dtype=torch.float64)
    image = smooth_noise(side, 5).flatten()
    grain = torch.rand(len(image), generator=torch.Generator().manual_seed(6)).double() - 0.5
    unary = Table((image + 0.3 * grain)[:, None].sub(levels).square())
    edges = grid_edges(side, side, side - 1, side - 1)
    pairwise = Potts(torch.full((len(edges),), 0.01, dtype=torch.float64))
    start, proposals = unary.costs.argmin(1), every_label(count, len(image))
    works, energies = {}, {}
    for key, solver in (("pymaxflow", PyMaxflow()), ("ortools", OrTools())):

        def work(solver=solver, key=key):
            energies[key] = expand(start, proposals, unary, edges, pairwise, solver=solver)[1]

        works[key] = work
    ms = in_turn(works, max(1, repeats // 5))
    moves = {key: len(found) - 1 for key, found in energies.items()}
    print(f"expansion: {ms['pymaxflow']['median'] / moves['pymaxflow']:.1f} ms a move", flush=True)
    return {
        "ms": ms,
        "moves": moves,
        "energy": {key: [found[0], found[-1]] for key, found in energies.items()},
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(__file__).parent / "results" / "cuts.json"
    everything = "mincut,patch,quilt,expansion"
    add_arguments(parser, threads=None, repeats=15, sections=everything, out=default)
    options = parser.parse_args()
    torch.set_num_threads(1)
    keep_memory()
    photos, repeats = photos_of(options), options.repeats
    sections = {
        "mincut": lambda: mincut(repeats),
        "patch": lambda: patch(photos, repeats),
        "quilt": lambda: quilt(photos, repeats),
        "expansion": lambda: expansion(repeats),
    }
    about = {"environment": environment(1, "PyMaxflow", "ortools"), "target": TARGET}
    measured(options.out, about, sections, options.sections)


if __name__ == "__main__":
    main()
