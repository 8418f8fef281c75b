"""Patch search: transforms and the quadtree pyramid against exhaustive search, as JSON and a table.

Sections: `fft` (a 128 x 128 template in 256 x 256), `qtp` (L-shaped zones of patches of 32, 64 and
92 pixels in exemplars of 360 x 360).

Exhaustive search is measured in two ways: by its definition (`ssd_exhaustive`: one template pixel
after another against all positions) and as convolutions by torch (sum m t^2 - 2 z * mt + z^2 * m).
Transforms are measured with the exemplar's kept, as in a run of many searches, and made anew.

Zones are of two kinds. `grown`: those that come up when patches are pasted in raster order, each
chosen within a tenth of the least cost but never a verbatim continuation, so that the two arms of
a zone come from two places of the exemplar. `fresh`: cut from another texture of the same kind,
synthesised from a corner of the photo, so that one exact arm seldom exists.
"""

import argparse
import math
import statistics
from itertools import pairwise

import torch
import torch.nn.functional as F
from common import add_arguments, environment, measured, photos_of, timed
from exemplars import crop

import torchtex
from torchtex.patches import ssd, ssd_exhaustive, ssd_search
from torchtex.picks import pick
from torchtex.qtp import Qtp

SIDE = 360
SIZES = (32, 64, 92)
TARGET = {"fft_speedup": 10, "fft_error": 1e-4, "qtp_speedup": 5, "qtp_excess": 1.05}


def convolved(z, t, mask):
    """Exhaustive search as two convolutions, in the dtype of the exemplar."""
    m = mask.to(z)
    cross = F.conv2d(z[None], (t * m)[None])[0, 0]
    squares = F.conv2d(z.square().sum(0)[None, None], m[None, None])[0, 0]
    return (m * t.square()).sum() - 2 * cross + squares


def fft(photos, repeats):
    """A 128 x 128 template in a 256 x 256 exemplar; the template is another photo's corner."""
    names = [name for name, photo in photos.items() if min(photo.shape[1:]) >= 256]
    rows = []
    for name, other in pairwise(names[:5]):
        for dtype in (torch.float32, torch.float64):
            z, t = crop(photos[name], 256).to(dtype), crop(photos[other], 128).to(dtype)
            everywhere = torch.ones(128, 128, dtype=torch.bool)
            search = ssd_search(z)
            exact = ssd_exhaustive(z.double(), t.double())
            row = {"exemplar": name, "template": other, "dtype": str(dtype)}
            row["error"] = float(((ssd(z, t).double() - exact) / exact).abs().max())
            row["seconds"] = {
                "definition": timed(lambda z=z, t=t: ssd_exhaustive(z, t), 1),
                "transforms": timed(lambda z=z, t=t: ssd(z, t), repeats),
                "kept": timed(lambda s=search, t=t: s(t[None]), repeats),
            }
            if dtype == torch.float32:  # in float64 torch unfolds it into gigabytes
                row["seconds"]["convolution"] = timed(
                    lambda z=z, t=t, m=everywhere: convolved(z, t, m), repeats
                )
            seconds = {key: value["cpu"] for key, value in row["seconds"].items()}
            row["speedup"] = {key: value / seconds["transforms"] for key, value in seconds.items()}
            rows.append(row)
            print(
                f"fft {name} {dtype}: " + ", ".join(f"{k} {s:.4f} s" for k, s in seconds.items())
                + f", largest error {row['error']:.1e}", flush=True,
            )  # fmt: skip
    return rows


def qtp(photos, repeats, count, names):
    """Zones of width size/4 and size/6; time per query, time to fit, cost over the least cost."""
    rows = []
    for name in names:
        z = enlarged(photos[name])
        other = torchtex.synthesize(crop(photos[name], 128), (256, 256)).texture
        for size in SIZES:
            for part in (4, 6):
                rows += [
                    {"exemplar": name, "size": size, "width": size // part, **row}
                    for row in zone(z, other, size, size // part, repeats, count)
                ]
    print(table(rows), flush=True)
    return {"rows": rows, "table": table(rows)}


def zone(z, other, size, width, repeats, count):
    """Both kinds of queries for one zone."""
    mask = corner(size, width)
    search = ssd_search(z)
    fit = timed(lambda: Qtp().fit(z, mask), 1)
    index = Qtp().fit(z, mask)
    kinds = {
        "grown": grown(z, search, size, width, count),
        "fresh": fresh(other, size, count),
    }
    for kind, queries in kinds.items():
        one = queries[:1]
        least = search(queries, mask).flatten(1).double().amin(1)
        # a cost of nothing: any other answer would be infinitely worse, so ask for that one
        found = torch.cat([index.search(q[None], 1)[0] for q in queries])[:, 0].double()
        floor = 1e-6 * float(least.median())
        ratio = (found + floor) / (least + floor)

        def pyramid(queries=queries):
            return [index.search(q[None], 1) for q in queries]

        def transforms(queries=queries):
            return [search(q[None], mask) for q in queries[:10]]

        times = {
            "definition": (timed(lambda one=one: ssd_exhaustive(z, one[0], mask), 1), 1),
            "convolution": (timed(lambda one=one: convolved(z, one[0], mask), 1), 1),
            "fft": (timed(transforms, repeats), min(10, len(queries))),
            "qtp": (timed(pyramid, repeats), len(queries)),
            "qtp_batch": (timed(lambda q=queries: index.search(q, 1), repeats), len(queries)),
            "fit": (fit, 1),
        }
        wall = {key: value["median"] / calls for key, (value, calls) in times.items()}
        seconds = {key: value["cpu"] / calls for key, (value, calls) in times.items()}
        seconds["qtp_100"] = seconds["qtp"] + seconds["fit"] / 100
        yield {
            "kind": kind,
            "queries": len(queries),
            "wall": wall,
            "cpu": seconds,
            "ratio": {
                "median": float(ratio.median()),
                "p90": float(ratio.quantile(0.9)),
                "worst": float(ratio.max()),
                "exact": float((ratio < 1 + 1e-4).double().mean()),
            },
        }


def enlarged(photo):
    """The photo mirrored at its right and bottom edges up to 360 x 360: as sharp as it was."""
    right, below = (max(0, SIDE - side) for side in (photo.shape[2], photo.shape[1]))
    return F.pad(photo[None], (0, right, 0, below), mode="reflect")[0][:, :SIDE, :SIDE].contiguous()


def corner(size, width):
    """The zone of a patch that has neighbours above and to the left."""
    mask = torch.ones(size, size, dtype=torch.bool)
    mask[width:, width:] = False
    return mask


def grown(z, search, size, width, count):
    """Zones of patches pasted in raster order; those with both neighbours."""
    generator = torch.Generator().manual_seed(0)
    step, side = size - width, math.ceil(count**0.5) + 1
    x = z.new_zeros(len(z), side * step + width, side * step + width)
    zones = []
    for i in range(side):
        for j in range(side):
            here = x[:, i * step : i * step + size, j * step : j * step + size]
            mask = corner(size, width)
            mask[:width, width:] &= i > 0
            mask[width:, :width] &= j > 0
            costs = search(here[None], mask)[0]
            if i and j:
                zones.append(here.clone())
            elif not i and not j:
                costs = torch.ones_like(costs)
            costs[costs < 1e-3 * costs.median()] = torch.inf  # the pixels that came next there
            row, col = pick(costs, 0.1, generator)
            here.copy_(z[:, row : row + size, col : col + size])
    return torch.stack(zones[:count])


def fresh(other, size, count):
    """Zones anywhere in another texture."""
    generator = torch.Generator().manual_seed(1)
    at = torch.randint(other.shape[1] - size + 1, (count, 2), generator=generator).tolist()
    return torch.stack([other[:, r : r + size, c : c + size] for r, c in at])


def table(rows):
    """Medians over exemplars, CPU time; speedups are over the quicker exhaustive search."""
    lines = [
        "| patch | zone | queries | definition ms | convolution ms | FFT ms | QTP ms | batch ms "
        "| fit s | speedup | with fit over 100 | over FFT | SSD median | worst | p90 | exact |",
        "|" + "---|" * 16,
    ]
    keys = sorted({(row["size"], -row["width"], row["kind"]) for row in rows})
    for size, width, kind in keys:
        group = [r for r in rows if (r["size"], -r["width"], r["kind"]) == (size, width, kind)]
        s = {k: statistics.median(r["cpu"][k] for r in group) for k in group[0]["cpu"]}
        q = {k: statistics.median(r["ratio"][k] for r in group) for k in group[0]["ratio"]}
        slow = min(s["definition"], s["convolution"])
        worst = max(r["ratio"]["median"] for r in group)
        lines.append(
            f"| {size} | {-width} | {kind} | {1e3 * s['definition']:.0f} "
            f"| {1e3 * s['convolution']:.0f} | {1e3 * s['fft']:.1f} | {1e3 * s['qtp']:.1f} "
            f"| {1e3 * s['qtp_batch']:.1f} | {s['fit']:.2f} | {slow / s['qtp']:.1f} "
            f"| {slow / s['qtp_100']:.1f} | {s['fft'] / s['qtp']:.1f} | {q['median']:.3f} "
            f"| {worst:.3f} | {q['p90']:.3f} | {100 * q['exact']:.0f} % |"
        )
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser, threads=1, repeats=3, sections="fft,qtp")
    parser.add_argument("--queries", type=int, default=40)
    parser.add_argument("--names", default="grass_lawn,brick_gray,pebbles_mixed,leaf_litter")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    photos = photos_of(options)
    names = [name for name in options.names.split(",") if name in photos] or list(photos)[:4]
    sections = {
        "fft": lambda: fft(photos, options.repeats),
        "qtp": lambda: qtp(photos, options.repeats, options.queries, names),
    }
    about = {"target": TARGET, "environment": environment(options.threads, "faiss-cpu")}
    measured(options.out / "search.json", about, sections, options.sections)


if __name__ == "__main__":
    main()
