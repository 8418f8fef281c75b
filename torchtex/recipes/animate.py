"""Textures that move along a flow: frame by frame, each steered by the one before.

Source: Kwatra et al. 2005, section 4.1 and Algorithm 2.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtex.cuts.mincut import MinCut, default_solver
from torchtex.flow.fields import Flow, check_flow, field_at
from torchtex.flow.warps import invert, warp
from torchtex.inputs import check_not_negative, check_seed
from torchtex.model import Search
from torchtex.recipes.frames import Frame, warp_error
from torchtex.recipes.homecoming import Homecoming, homecoming
from torchtex.recipes.moving import Canvas, Costs
from torchtex.recipes.piece_search import use_of
from torchtex.recipes.pieces import OLD, Pieces, Stock, pieces_of, rendered, stock_of
from torchtex.synthesize import synthesize

_BAR = 0.1  # cost of seams from which on a new piece is tried over them
_COVERS = 16  # most new pieces in one frame
_ROUNDS = 5  # that mend the first frame
_LEAST = 0.1  # share of a square piece below which a piece is taken away


@dataclass(frozen=True)
class Motion:
    """How a frame follows from the one before.

    Args:
        patch: side of the pieces that a frame is made of, in pixels. Large ones show more whole
            objects, small ones follow the flow more closely.
        hold: how closely a frame keeps to the one before: cost of the difference of a pixel from
            the warped frame before, against 1 for a seam. Large values follow the flow more
            closely and change less, small ones mend more seams and look more like the exemplar.
        follow: cost of a pixel whose piece does not move as the flow does there, per pixel.
        repeat: how far new pieces keep away from parts of the exemplar that are shown already.
        balance: cost of a pixel from a part of the exemplar that is shown twice as often as in
            the first frame. Flat parts meet anything without a seam and would crowd out the rest,
            such as mortar between bricks. What is brought back comes from nowhere.
        mend: how many new pieces are tried in each frame, over its worst seams.
        fade: over so many frames a pixel passes from one piece into another.
        steps: pieces move in steps of one over this many pixels. 1 copies the exemplar's own
            pixels, and moves less smoothly.

    Raises:
        ValueError: a number out of range.

    Example:
        >>> Motion().patch
        48
    """

    patch: int = 48
    hold: float = 0.1
    follow: float = 0.01
    repeat: float = 1.0
    balance: float = 0.045
    mend: int = 12
    fade: int = 3
    steps: int = 4

    def __post_init__(self) -> None:
        if self.patch < 4:
            raise ValueError(f"patch={self.patch} must be at least 4")
        for name in ("hold", "follow", "repeat", "balance", "mend"):
            check_not_negative(name, float(getattr(self, name)))
        if not 0 <= self.fade < 100:
            raise ValueError(f"fade={self.fade} must lie in 0..99")
        if not 1 <= self.steps <= 8:
            raise ValueError(f"steps={self.steps} must lie in 1..8")


def animate(
    exemplars: Float[Tensor, "c _ _"] | Sequence[Float[Tensor, "c _ _"]],
    size: tuple[int, int],
    flow: Flow,
    frames: int,
    *,
    masks: Bool[Tensor, "_ _"] | Sequence[Bool[Tensor, "_ _"] | None] | None = None,
    motion: Motion = Motion(),
    boundary: str = "free",
    loop: int = 0,
    search: Search | None = None,
    solver: MinCut | None = None,
    seed: int = 0,
    resume: Frame | None = None,
    on_frame: Callable[[Frame], None] | None = None,
) -> Iterator[Frame]:
    """Frames of a texture that moves along a flow and stays a texture; made as they are asked for.

    The first frame is a synthesis, cut into pieces of the exemplar. From frame to frame each piece
    moves as a whole, with the exemplar's own orientation and size, as the flow moves its
    structure. Min-cuts find where pieces that slide over each other meet; new pieces appear where
    the flow brings in new pixels, and over seams that show.

    Memory does not grow with the number of frames.

    Args:
        exemplars: one image or several, as in `synthesize`.
        size: height and width of a frame.
        flow: where pixels go; see `flow.fields.Flow`.
        frames: how many.
        masks: True where an exemplar may be used.
        motion: how a frame follows from the one before.
        boundary: "periodic" for frames that tile.
        loop: over so many frames at the end the texture returns to the first frame, which comes
            again after the last one; 0 does not. Their pieces are kept in memory.
        search: of the synthesis of the first frame, see `synthesize`.
        solver: of the min-cuts; the first one that is installed unless given.
        seed: of the first frame.
        resume: go on after this frame of the same animation.
        on_frame: called with every frame; raise from it to cancel.

    Raises:
        ValueError: an option out of range, or a flow that is none; what `synthesize` refuses.

    Source: Kwatra et al. 2005, section 4.1.

    Example:
        >>> from torchtex.flow.fields import Uniform
        >>> moving = animate(torch.rand(1, 32, 32), (32, 40), Uniform((0.0, 2.0)), 3)
        >>> [frame.number for frame in moving]
        [0, 1, 2]
    """
    if frames < 1:
        raise ValueError(f"frames={frames} must be at least 1")
    if not 0 <= loop < frames:
        raise ValueError(f"loop={loop} must be at least 0 and below frames={frames}")
    if boundary not in ("free", "periodic"):
        raise ValueError(f"boundary={boundary!r} must be free or periodic")
    check_seed(seed)
    check_flow(flow, size, frames + 1 if loop else frames)
    solver = default_solver() if solver is None else solver
    zs = [exemplars] if isinstance(exemplars, Tensor) else list(exemplars)
    keep = [masks] if isinstance(masks, Tensor) else masks
    make = _Maker(zs, keep, size, flow, frames, motion, boundary == "periodic", loop, search,
                  solver, seed)  # fmt: skip
    return make.frames_from(resume, on_frame)


@dataclass(frozen=True)
class _Maker:
    """Makes the frames of one animation."""

    exemplars: Sequence[Tensor]
    masks: Sequence[Tensor | None] | None
    size: tuple[int, int]
    flow: Flow
    frames: int
    motion: Motion
    periodic: bool
    loop: int
    search: Search | None
    solver: MinCut
    seed: int

    def frames_from(
        self, frame: Frame | None, on_frame: Callable[[Frame], None] | None
    ) -> Iterator[Frame]:
        stock: Stock | None = None
        home: Homecoming | None = None
        if frame is None or self.loop:
            stock, first = self.first()
            if self.loop:
                home = self.way_home(first, stock)
            if frame is None:
                frame = first
                if on_frame is not None:
                    on_frame(frame)
                yield frame
            del first
        for number in range(frame.number + 1, self.frames):
            stock = self.stock() if stock is None else stock
            frame = self.next(frame, number, stock, home)
            if on_frame is not None:
                on_frame(frame)
            yield frame

    def stock(self) -> Stock:
        return stock_of(
            self.exemplars, self.masks, self.size,
            periodic=self.periodic, side=self.motion.patch, steps=self.motion.steps,
        )  # fmt: skip

    def first(self) -> tuple[Stock, Frame]:
        began = time.perf_counter()
        still = synthesize(
            self.exemplars, self.size, masks=self.masks,
            boundary="periodic" if self.periodic else "free", search=self.search, seed=self.seed,
        )  # fmt: skip
        stock = self.stock()
        generator = torch.Generator().manual_seed(self.seed)
        pieces = pieces_of(still.source_map, stock.side, generator)
        flow = field_at(self.flow, 0, self.size).to(still.texture.device)
        # nothing has to be held yet: pieces of a few pixels go, and all seams are mended
        costs = Costs(self.motion.follow, 0.0, self.motion.repeat)
        for rest in reversed(range(_ROUNDS)):
            canvas = Canvas(pieces, stock, flow, costs, self.solver)
            self.fill(canvas, _least(stock))
            canvas.mend(_least(stock))
            canvas.renew(2 * self.motion.mend if rest else 0, _BAR)
            pieces = canvas.done(0)
        # shown at once: there was no frame from which they could be faded in
        pieces = replace(pieces, before=pieces.owner.clone(), age=torch.full_like(pieces.age, OLD))
        texture, field = rendered(pieces, stock, 0)
        none = torch.zeros(self.size, dtype=torch.bool, device=texture.device)
        seconds = time.perf_counter() - began
        usual = tuple(use_of(pieces, stock))
        made = Frame(0, texture, field, none.to(texture), 0.0, seconds, pieces, none, usual)
        return stock, made

    def fill(self, canvas: Canvas, least: int) -> None:
        """No pixel is left without a piece, and none has one of fewer pixels."""
        canvas.drop(least)
        canvas.grow()
        canvas.show()
        canvas.cover(_COVERS)
        canvas.grow(anywhere=True)

    def moved(self, last: Frame, flow: Tensor, number: int, stock: Stock, warped: Tensor) -> Pieces:
        """The pieces of the next frame: half of them grow, the other half in the frame after."""
        motion = self.motion
        costs = Costs(motion.follow, motion.hold, motion.repeat, motion.balance)
        canvas = Canvas(
            last.pieces, stock, flow, costs, self.solver,
            last=last.texture, wished=warped, usual=last.usual,
        )  # fmt: skip
        canvas.move()
        self.fill(canvas, _least(stock) // 5)
        canvas.mend(_least(stock), range(number % 2, len(canvas.pieces.which), 2))
        canvas.renew(motion.mend, _BAR)
        return canvas.done(motion.fade)

    def next(self, last: Frame, number: int, stock: Stock, home: "Homecoming | None") -> Frame:
        began = time.perf_counter()
        flow = field_at(self.flow, number - 1, self.size).to(last.texture.device)
        backward, seen = invert(flow.to(last.texture), periodic=self.periodic)
        warped = warp(last.texture, backward, periodic=self.periodic).clamp(0, 1)
        pieces = self.moved(last, flow, number, stock, warped)
        shown, at_home = pieces, last.home
        if home is not None and home.left(number) <= self.loop:
            shown, at_home = home.joined(pieces, last.home, backward, number)
        texture, field = rendered(shown, stock, self.motion.fade)
        error = warp_error(texture, warped, seen.to(texture))
        seconds = time.perf_counter() - began
        return Frame(
            number, texture, field, seen.to(texture), error, seconds, pieces, at_home, last.usual
        )

    def way_home(self, first: Frame, stock: Stock) -> Homecoming:
        """The pieces of the frames before the first one, had the flow led to it."""
        ways: list[Pieces] = []
        for step in range(1, self.loop + 1):
            flow = field_at(self.flow, self.frames - step, self.size).to(first.texture.device)
            back = invert(flow, periodic=self.periodic)[0]
            shown = rendered(first.pieces, stock, self.motion.fade)[0]
            warped = warp(shown, flow, periodic=self.periodic).clamp(0, 1)
            pieces = self.moved(replace(first, texture=shown), back, step, stock, warped)
            first = replace(first, pieces=pieces)
            ways.append(pieces)
        return homecoming(ways, stock, self.frames, self.solver, self.seed)


def _least(stock: Stock) -> int:
    return max(1, int(_LEAST * stock.side**2))
