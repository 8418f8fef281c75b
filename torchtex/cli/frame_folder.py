"""A folder of frames, and the state that a run of `torchtex animate` goes on from."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch

    from torchtex.recipes.frames import Frame

STATE = "state.npz"
_AGAIN = "empty the folder to start again"


class FrameFolder:
    """A folder of frames, and the state that a run goes on from; all frames are of one run.

    The state stays when a run is done: more frames may be wanted later, and those that are there
    are not mixed with others.

    Args:
        folder: made with the first frame.
        name: the option that names it, for errors.
        about: what decides the frames; another run is refused.
        record: kept in each frame, for `torchtex repeat`.
    """

    def __init__(
        self, folder: Path, name: str, about: dict[str, Any], record: dict[str, Any]
    ) -> None:
        self.folder, self.where = folder, f"{name}={str(folder)!r}"
        self.about = json.loads(json.dumps(about))
        self.record = {"torchtex": json.dumps(record, sort_keys=True)}

    def resumed(self, most: int | None) -> "tuple[Frame | None, list[dict[str, Any]]]":
        """The last frame that is there, None before the first, and the lines kept with it.

        Args:
            most: frames that the folder may hold; None for any number.

        Raises:
            ValueError: frames of another run, or more than `most`, or some are missing.
        """
        from torchtex.video import frame_numbers

        frame, lines = self._state()
        there = frame_numbers(self.folder)
        last = -1 if frame is None else frame.number
        # one more may have been written before an interrupt, and is written again
        if any(number > last + 1 for number in there):
            raise ValueError(
                f"{self.where} holds frame {there[-1]} without the state that it belongs to; "
                "empty it, or name another folder"
            )
        missing = sorted({*range(last + 1)} - {*there})
        if missing:
            raise ValueError(f"{self.where}: frame {missing[0]} is missing; {_AGAIN}")
        if most is not None and there and there[-1] >= most:
            count = there[-1] + 1
            raise ValueError(
                f"{self.where} holds {count} frames and {most} are wanted; ask for at least "
                f"{count}, empty it, or name another folder"
            )
        return frame, lines

    def _state(self) -> "tuple[Frame | None, list[dict[str, Any]]]":
        from torchtex.recipes.frames import load_frame

        path = self.folder / STATE
        if not path.exists():
            return None, []
        try:
            frame, text = load_frame(path)
            kept = json.loads(text)
        except ValueError:
            raise ValueError(f"{self.where}: its {STATE} is damaged; {_AGAIN}") from None
        if kept.get("about") != self.about:
            raise ValueError(
                f"{self.where} holds frames of other options, pictures or of another version; "
                "empty it, or name another folder"
            )
        return frame, kept["lines"]

    def pictures(self, count: int) -> "Iterator[torch.Tensor]":
        """The first frames, read back.

        Raises:
            ValueError: one is damaged.
        """
        from torchtex import image as images
        from torchtex.video import frame_name

        for number in range(count):
            try:
                yield images.load(self.folder / frame_name(number)).image
            except ValueError:
                raise ValueError(f"{self.where}: frame {number} is damaged; {_AGAIN}") from None

    def keep(self, frame: "Frame", lines: list[dict[str, Any]]) -> None:
        """Writes a frame, then the state: a state never names a frame that is not there.

        Args:
            lines: what the report says of each frame up to this one.
        """
        from torchtex import image as images
        from torchtex.recipes.frames import save_frame
        from torchtex.video import frame_name

        self.folder.mkdir(exist_ok=True)
        path = self.folder / frame_name(frame.number)
        images.save(path, frame.texture, metadata=self.record)
        about = json.dumps({"about": self.about, "lines": lines})
        save_frame(self.folder / STATE, frame, about)
