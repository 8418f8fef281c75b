"""Markdown tables of what bench.py measured."""

import statistics
from collections.abc import Iterable, Sequence

METRICS = ("tail", "miss", "swd", "spec", "copy", "repeat")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def summary(rows, key):
    """Median, least and most of some numbers."""
    values = [row[key] for row in rows]
    return statistics.median(values), min(values), max(values)


def mstep(rows):
    """Exact against fast search: one line per exemplar size and window."""
    kinds = sorted({(row["extent"], row["window"]) for row in rows}, key=lambda k: (k[0], -k[1]))
    lines = []
    for extent, window in kinds:
        some = [row for row in rows if (row["extent"], row["window"]) == (extent, window)]
        exact = statistics.median(row["exact"]["cpu"] for row in some)
        fast = statistics.median(row["fast"]["cpu"] for row in some)
        middle, least, most = summary(some, "ratio")
        lines.append(
            (f"{extent} to {2 * extent}", str(window), f"{1000 * exact:.0f}", f"{1000 * fast:.0f}",
             f"{middle:.1f} ({least:.1f} to {most:.1f})")
        )  # fmt: skip
    return "M-step at full scale, CPU milliseconds, medians over exemplars\n\n" + table(
        ("size", "window", "exact", "fast", "exact / fast"), lines
    )


def energies(rows):
    """What the fast search costs in final energy, per exemplar."""
    middle, least, most = summary(rows, "excess")
    over = sum(row["excess"] > 0.02 for row in rows)
    lines = [(row["exemplar"], f"{100 * row['excess']:+.1f} %") for row in rows]
    return (
        "Final energy, fast over exact search: "
        f"median {100 * middle:+.1f} % ({100 * least:+.1f} to {100 * most:+.1f} %), "
        f"above 2 % on {over} of {len(rows)} exemplars\n\n" + table(("exemplar", "excess"), lines)
    )


def estep(rows):
    """Seconds and energy of each solver per feature."""
    lines = [
        (
            row["feature"],
            row["solver"].split("(")[0] + (" adam" if "adam" in row["solver"] else ""),
            f"{row['seconds']['cpu']:.2f}",
            f"{row['energy']:.4f}",
        )
        for row in rows
    ]
    return "One E-step of 256 x 256: CPU seconds, energy after over before\n\n" + table(
        ("feature", "solver", "CPU s", "energy"), lines
    )


def runs(rows):
    """Whole syntheses: medians over exemplars."""
    lines = []
    for case in sorted({(row["extent"], row["size"]) for row in rows}):
        some = [row for row in rows if (row["extent"], row["size"]) == case]
        middle, least, most = summary(some, "seconds")
        cpu = statistics.median(row["cpu"] for row in some)
        peak = max(row["peak_mib"] for row in some)
        lines.append(
            (f"{case[0]} to {case[1]}", str(len(some)),
             f"{middle:.2f} ({least:.2f} to {most:.2f})", f"{cpu:.2f}", f"{peak:.0f}")
        )  # fmt: skip
    return "Whole runs with the defaults\n\n" + table(
        ("size", "exemplars", "seconds", "CPU s", "most memory, MiB"), lines
    )


def growth(rows):
    """Time and memory against output pixels."""
    lines = [
        (
            str(row["size"]),
            f"{row['cpu']:.1f}",
            f"{1e6 * row['cpu'] / row['size'] ** 2:.1f}",
            f"{row['peak_mib']:.0f}",
            f"{2**20 * (row['peak_mib'] - row['idle_mib']) / row['size'] ** 2:.0f}",
        )
        for row in rows
    ]
    return "Growth with the output, from 256 px\n\n" + table(
        ("side", "CPU s", "CPU µs a pixel", "peak MiB", "bytes a pixel above idle"), lines
    )


def features(rows):
    """The battery per feature: medians over exemplars, then which wins where."""
    kinds = list(dict.fromkeys(row["feature"] for row in rows))
    lines = []
    for kind in kinds:
        some = [row for row in rows if row["feature"] == kind]
        values = [statistics.median(row["metrics"][name] for row in some) for name in METRICS]
        cpu = statistics.median(row["cpu"] for row in some)
        lines.append((kind, *(f"{value:.3f}" for value in values), f"{cpu:.1f}"))
    text = "Features, 128 to 256: medians over exemplars\n\n"
    text += table(("feature", *METRICS, "CPU s"), lines)
    names = list(dict.fromkeys(row["exemplar"] for row in rows))
    wins = []
    for name in names:
        cells = [name]
        for metric in ("tail", "miss", "swd", "copy"):
            values = {
                kind: statistics.mean(
                    row["metrics"][metric]
                    for row in rows
                    if row["feature"] == kind and row["exemplar"] == name
                )
                for kind in kinds
            }
            best = min(values, key=lambda kind: values[kind])
            cells.append(" / ".join(
                f"**{values[kind]:.3f}**" if kind == best else f"{values[kind]:.3f}"
                for kind in kinds
            ))  # fmt: skip
        wins.append(cells)
    order = " / ".join(kinds)
    return (
        text
        + f"\n\nPer exemplar, {order}; the lowest in bold\n\n"
        + table(("exemplar", "tail", "miss", "swd", "copy"), wins)
    )


SECTIONS = {
    "runs": runs,
    "growth": growth,
    "mstep": mstep,
    "energies": energies,
    "estep": estep,
    "features": features,
}


def render(report):
    """All sections that a report has, as one page."""
    about = report["environment"]
    parts = ["# Speed, memory and features", ", ".join(f"{k} {v}" for k, v in about.items())]
    parts += [f"## {SECTIONS[key](report[key])}" for key in SECTIONS if key in report]
    return "\n\n".join(parts) + "\n"
