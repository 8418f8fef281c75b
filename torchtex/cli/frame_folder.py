"""A folder of frames, and the state that a run of `torchtex animate` goes on from."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch

    from torchtex.recipes.frames import Frame

STATE = "state.npz"


class FrameFolder:
    """A folder of frames, and the state that a run goes on from."""

    def __init__(self, folder: Path, about: dict[str, Any], record: dict[str, Any]) -> None:
        self.folder, self.about = folder, json.dumps(about, sort_keys=True)
        self.record = {"torchtex": json.dumps(record, sort_keys=True)}

    def resumed(self) -> "Frame | None":
        """The last frame that is there, if it is of the same run."""
        from torchtex.recipes.frames import load_frame

        path = self.folder / STATE
        if not path.exists():
            return None
        frame, about = load_frame(path)
        if about != self.about:
            raise ValueError(
                f"output={str(self.folder)!r} holds frames of other options; empty it, or name "
                "another folder"
            )
        return frame

    def pictures(self, count: int) -> "Iterator[torch.Tensor]":
        """The frames before the one to go on from, read back."""
        from torchtex import image as images
        from torchtex.video import frame_name

        for number in range(count):
            yield images.load(self.folder / frame_name(number), name="frame").image

    def keep(self, frame: "Frame") -> None:
        """Writes a frame, then the state: a state never names a frame that is not there."""
        from torchtex import image as images
        from torchtex.recipes.frames import save_frame
        from torchtex.video import frame_name

        self.folder.mkdir(exist_ok=True)
        path = self.folder / frame_name(frame.number)
        images.save(path, frame.texture, metadata=self.record)
        save_frame(self.folder / STATE, frame, self.about)

    def done(self) -> None:
        """Nothing is left to go on from."""
        (self.folder / STATE).unlink(missing_ok=True)
