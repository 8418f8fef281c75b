"""Contact sheets: each exemplar beside what the methods made of it, pixel for pixel.

    python benchmarks/sheets.py --results benchmarks/results --rows 5

It shows pictures that `peers.py` left under `--results`; it synthesises nothing.
"""

import argparse
import json
from collections.abc import Sequence
from itertools import count
from pathlib import Path

from peers import NAMES, ROOT, SIZE, SYNTHESIZERS
from PIL import Image, ImageDraw, ImageFont

MARGIN = 8
LINE = 20  # height of a line of text
INK, DIM, PAPER = (20, 20, 20), (110, 110, 110), (255, 255, 255)
SHOWN = ("tail", "miss", "swd", "copy")


def caption(picture: Path) -> str:
    """The measurements that `peers.py` stored beside a picture, in one line."""
    try:
        metrics = json.loads(picture.with_suffix(".json").read_text())["metrics"]["value"]
    except (OSError, ValueError, KeyError):
        return ""
    return "  ".join(f"{name} {metrics[name]:.2f}" for name in SHOWN)


def sheet(pictures: Path, cases: Sequence[str], methods: Sequence[str], seed: int) -> Image.Image:
    """One sheet: a row for each exemplar, a column for each method.

    Args:
        pictures: the folder `peers` under the results.
        cases: names of exemplars.
        methods: names of synthesis methods; a picture that was not made leaves its place empty.
        seed: which of the pictures to show.
    """
    font = ImageFont.load_default(size=14)
    small = ImageFont.load_default(size=12)
    exemplars = [Image.open(pictures / "exemplar" / f"{case}.png") for case in cases]
    first = max(image.width for image in exemplars) + MARGIN
    width = MARGIN + first + len(methods) * (SIZE + MARGIN)
    height = MARGIN + LINE + len(cases) * (SIZE + LINE + MARGIN)
    page = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(page)
    lefts = [MARGIN + first + column * (SIZE + MARGIN) for column in range(len(methods))]
    for left, method in zip(lefts, methods, strict=True):
        draw.text((left, MARGIN), NAMES[method], INK, font)
    tops = count(MARGIN + LINE, SIZE + LINE + MARGIN)
    for top, case, exemplar in zip(tops, cases, exemplars, strict=False):
        page.paste(exemplar, (MARGIN, top))
        draw.text((MARGIN, top + exemplar.height + 2), case, INK, small)
        for left, method in zip(lefts, methods, strict=True):
            picture = pictures / method / f"{case}_{seed}.png"
            if picture.exists():
                page.paste(Image.open(picture), (left, top))
                draw.text((left, top + SIZE + 2), caption(picture), DIM, small)
            else:
                draw.rectangle((left, top, left + SIZE - 1, top + SIZE - 1), outline=DIM)
                draw.text((left + MARGIN, top + MARGIN), "not made", DIM, small)
    return page


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Contact sheets of the peers' pictures.")
    results = ROOT / "benchmarks" / "results"
    parser.add_argument("--results", type=Path, default=results, metavar="DIR",
                        help="the folder that peers.py wrote with --out")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="DIR",
                        help="where the sheets go (default: RESULTS/sheets)")  # fmt: skip
    parser.add_argument("--cases", nargs="+", metavar="NAME", help="exemplars (default: all)")
    parser.add_argument("--methods", nargs="+", choices=list(SYNTHESIZERS), metavar="METHOD",
                        help="columns (default: all methods with pictures)")  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="which pictures to show")
    parser.add_argument("--rows", type=int, default=5, help="exemplars on a sheet")
    parser.add_argument("--format", choices=("jpg", "png"), default="jpg",
                        help="jpg (a quarter of the size) or png (exact)")  # fmt: skip
    options = parser.parse_args(arguments)
    if options.rows < 1:
        parser.error(f"--rows={options.rows} must be at least 1")
    return options


def main() -> None:
    options = parse()
    pictures = options.results / "peers"
    known = sorted(path.stem for path in (pictures / "exemplar").glob("*.png"))
    if not known:
        raise SystemExit(f"--results {options.results} has no pictures; run benchmarks/peers.py")
    cases = options.cases or known
    for case in cases:
        if case not in known:
            raise SystemExit(f"--cases {case} has no pictures; choose from {', '.join(known)}")
    methods = options.methods or [
        method for method in SYNTHESIZERS if any((pictures / method).glob("*.png"))
    ]
    out = options.out or options.results / "sheets"
    out.mkdir(parents=True, exist_ok=True)
    for number, start in enumerate(range(0, len(cases), options.rows), 1):
        page = sheet(pictures, cases[start : start + options.rows], methods, options.seed)
        path = out / f"sheet_{number}.{options.format}"
        page.save(path, quality=88, optimize=True)
        print(f"{path}: {page.width} x {page.height}, {path.stat().st_size // 1024} KiB")


if __name__ == "__main__":
    main()
