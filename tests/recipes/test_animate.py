"""Textures along flows: the first frame, what follows, constant memory, bad input."""

import gc
import itertools
import math
import re
import weakref
from pathlib import Path

import pytest
import torch
from conftest import noise, stripes
from torch import Tensor

from torchtex.flow.fields import Flow, Given, Scaled, Summed, Uniform
from torchtex.flow.formulas import Rotation, Sink, Source
from torchtex.recipes.animate import Motion, animate
from torchtex.recipes.frames import Frame, load_frame, save_frame, warp_error
from torchtex.recipes.pieces import OLD
from torchtex.synthesize import synthesize

STILL = Uniform((0.0, 0.0))


def drawn(flow: Flow, frames: int = 3, **options: object) -> list[Frame]:
    """A small animation."""
    return list(animate(stripes(32, 32), (36, 40), flow, frames, **options))  # type: ignore[arg-type]


def test_the_first_frame_is_a_synthesis_of_whole_pixels() -> None:
    first = next(animate(stripes(32, 32), (36, 40), STILL, 1, seed=3))
    still = synthesize(stripes(32, 32), (36, 40), seed=3)
    assert (first.texture - still.texture).square().mean().sqrt() < 0.2
    assert torch.equal(first.field.apply(stripes(32, 32)), first.texture)
    assert first.number == 0
    assert first.warp_error == 0


def test_nothing_of_the_first_frame_is_still_being_faded_in() -> None:
    first = drawn(STILL, 1, motion=Motion(fade=5))[0]
    assert torch.equal(first.pieces.before, first.pieces.owner)
    assert bool((first.pieces.age == OLD).all())


def test_without_motion_little_changes() -> None:
    frames = drawn(STILL, 4)
    for before, after in itertools.pairwise(frames):
        assert (before.texture - after.texture).square().mean().sqrt() < 0.05
        assert after.confidence.min() == 1


def test_maps_are_rendered_as_the_texture_where_pixels_are_copied() -> None:
    frames = drawn(Source(1.5), 4, motion=Motion(steps=1, fade=0))
    for frame in frames:
        assert torch.equal(frame.field.apply(stripes(32, 32)), frame.texture)
    between = drawn(Source(1.5), 4)[-1]
    gap = between.field.apply(stripes(32, 32)) - between.texture
    assert gap.square().mean().sqrt() < 0.05


def test_pieces_keep_their_orientation_in_a_turn() -> None:
    lines = (torch.arange(32) % 8 < 4).to(torch.float64)[None, :, None].expand(1, 32, 32)
    *_, last = animate(lines.contiguous(), (48, 48), Rotation(6.0), 11)
    across, along = (last.texture.diff(dim=dim).abs().mean() for dim in (1, 2))
    assert across > 3 * along  # after 60 degrees the lines still lie level


def test_whole_pixels_move_along() -> None:
    frames = drawn(Uniform((0.0, 2.0)), 4)
    for before, after in itertools.pairwise(frames):
        gap = before.texture[:, :, 4:-6] - after.texture[:, :, 6:-4]
        assert gap.square().mean().sqrt() < 0.07
        assert after.confidence[:, 0].max() == 0  # what comes in is new
        assert after.warp_error < 0.07


@pytest.mark.parametrize("flow", [Source(1.5), Sink(1.5), Rotation(4.0)])
def test_a_texture_that_moves_stays_one(flow: Flow) -> None:
    frames = drawn(flow, 9)

    def sharp(image: Tensor) -> float:
        return float((image[:, 1:, 1:] - image[:, :-1, 1:]).abs().mean())

    assert sharp(frames[-1].texture) > 0.75 * sharp(frames[0].texture)
    for frame in frames:
        assert 0 <= frame.texture.min() <= frame.texture.max() <= 1
        assert frame.texture.dtype == torch.float64


def test_frames_are_tiles_when_periodic() -> None:
    frames = drawn(Uniform((1.0, 0.0)), 3, boundary="periodic")
    assert all(frame.confidence.min() == 1 for frame in frames[1:])
    for frame in frames:
        inside = frame.texture.diff(dim=1).abs().mean()
        across = (frame.texture[:, 0] - frame.texture[:, -1]).abs().mean()
        assert across < 1.5 * inside


@pytest.mark.parametrize("channels", [1, 4])
def test_channels(channels: int) -> None:
    *_, frame = animate(stripes(32, 32, channels), (32, 32), Uniform((1.0, 0.0)), 2)
    assert frame.texture.shape == (channels, 32, 32)


def test_several_exemplars_and_masks() -> None:
    mask = torch.ones(32, 32, dtype=torch.bool)
    mask[:, 26:] = False
    zs = [stripes(32, 32), stripes(36, 30, seed=1)]
    *_, frame = animate(zs, (32, 32), Uniform((1.0, 0.0)), 3, masks=[mask, None])
    which, _, column = frame.field.positions.unbind(-1)
    assert (column[which == 0] <= 25).all()


def test_seeds() -> None:
    same, again, other = (drawn(Source(1.0), 2, seed=seed)[1].texture for seed in (1, 1, 2))
    assert torch.equal(same, again)
    assert not torch.equal(same, other)


def test_threads_do_not_change_a_bit() -> None:
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(drawn(Source(1.5), 3)[-1].texture)
    assert torch.equal(*found)


def test_memory_does_not_grow() -> None:
    made: list[weakref.ref[Tensor]] = []
    for frame in animate(stripes(32, 32), (32, 32), Source(1.0), 6):
        made.append(weakref.ref(frame.texture))
        del frame
        gc.collect()
        assert sum(ref() is not None for ref in made) <= 1


def test_a_run_goes_on_from_a_saved_frame(tmp_path: Path) -> None:
    whole = drawn(Source(1.5), 5)
    save_frame(tmp_path / "state.npz", whole[2], "options")
    frame, about = load_frame(tmp_path / "state.npz")
    assert about == "options"
    rest = drawn(Source(1.5), 5, resume=frame)
    assert [frame.number for frame in rest] == [3, 4]
    for one, two in zip(whole[3:], rest, strict=True):
        assert torch.equal(one.texture, two.texture)
        assert torch.equal(one.pieces.owner, two.pieces.owner)


def test_a_loop_comes_back() -> None:
    frames = drawn(Uniform((0.0, 1.0)), 10, boundary="periodic", loop=5)
    again = frames[0].texture.roll(-1, 2)  # the frame before the first one
    gap = (frames[-1].texture - again).square().mean().sqrt()
    assert gap < 0.1
    open_ended = drawn(Uniform((0.0, 1.0)), 10, boundary="periodic")
    assert gap < (open_ended[-1].texture - again).square().mean().sqrt()
    resumed = drawn(Uniform((0.0, 1.0)), 10, boundary="periodic", loop=5, resume=frames[7])
    assert torch.equal(resumed[-1].texture, frames[-1].texture)


def test_on_frame_is_told_and_can_cancel() -> None:
    seen: list[int] = []

    def tell(frame: Frame) -> None:
        seen.append(frame.number)
        if frame.number == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        drawn(STILL, 4, on_frame=tell)
    assert seen == [0, 1]


def test_frames_are_made_as_they_are_asked_for() -> None:
    asked: list[int] = []

    class Watched:
        def __call__(self, frame: int, height: int, width: int) -> Tensor:
            asked.append(frame)
            return torch.zeros(2, height, width)

    moving = animate(stripes(32, 32), (32, 32), Watched(), 1000)
    next(moving)
    next(moving)
    assert max(asked) == 0


@pytest.mark.parametrize(
    ("words", "flow"),
    [
        ("8 x 8 pixels do not fit", Given(torch.zeros(2, 8, 8))),
        ("there are 2 flow fields", Given(torch.zeros(2, 2, 32, 32))),
        ("there are 2 flow fields", Summed((STILL, Scaled(Given(torch.zeros(2, 2, 32, 32)), 2.0)))),
        ("more than the width of 32", Uniform((0.0, 33.0))),
        ("more than the height of 32", Uniform((-40.0, 0.0))),
        ("NaN or infinity", lambda frame, h, w: torch.full((2, h, w), math.nan)),
        ("flow has fields of 9x9", lambda frame, h, w: torch.zeros(2, 9, 9)),
        ("must be (2, rows, columns)", lambda frame, h, w: torch.zeros(h, w, 2)),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_flows_that_are_refused_at_once(words: str, flow: Flow) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        animate(noise(1, 32, 32), (32, 32), flow, 5)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("frames=0", {"frames": 0}),
        ("frames=-1", {"frames": -1}),
        ("loop=5", {"loop": 5}),
        ("loop=9", {"loop": 9}),
        ("loop=-1", {"loop": -1}),
        ("boundary='round'", {"boundary": "round"}),
        ("seed=-1", {"seed": -1}),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_options_that_are_refused_at_once(words: str, options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=words):
        animate(noise(1, 32, 32), (32, 32), STILL, **({"frames": 5} | options))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("patch=3", {"patch": 3}),
        ("hold=-1", {"hold": -1.0}),
        ("hold=nan", {"hold": math.nan}),
        ("follow=-1", {"follow": -1.0}),
        ("repeat=-1", {"repeat": -1.0}),
        ("balance=-1", {"balance": -1.0}),
        ("mend=-1", {"mend": -1}),
        ("fade=-1", {"fade": -1}),
        ("steps=0", {"steps": 0}),
    ],
)
def test_motions_that_are_refused(words: str, options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=words):
        Motion(**options)  # type: ignore[arg-type]


def test_pieces_are_as_small_as_exemplars_ask_for() -> None:
    *_, frame = animate(noise(1, 20, 20), (32, 32), Source(1.0), 3, motion=Motion(48))
    assert frame.texture.shape == (1, 32, 32)


def test_pieces_that_all_leave_the_frame_are_followed_by_others() -> None:
    *_, frame = drawn(Uniform((0.0, 40.0)), 2)
    assert frame.confidence.max() == 0
    assert frame.texture.std() > 0.5 * stripes(32, 32).std()


@pytest.mark.parametrize("content", [b"", b"no state", None])
def test_states_that_are_none(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "state.npz").write_bytes(content)
    with pytest.raises(ValueError, match="not the state of an animation"):
        load_frame(tmp_path / "state.npz")


def test_slow_flows_add_up() -> None:
    frames = drawn(Uniform((0.0, 0.25)), 9, boundary="periodic")
    gap = frames[0].texture.roll(2, 2) - frames[-1].texture
    assert gap.square().mean().sqrt() < 0.07


def test_the_warp_error_counts_what_is_seen() -> None:
    seen = torch.zeros(4, 4)
    assert warp_error(torch.ones(1, 4, 4), torch.zeros(1, 4, 4), seen) == 0
    seen[0] = 1
    assert warp_error(torch.ones(1, 4, 4), torch.zeros(1, 4, 4), seen) == 1
