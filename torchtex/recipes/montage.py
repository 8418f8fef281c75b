"""What the recipes that copy patches return: pixels, sources, and which patch each pixel is of."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtex import image as images
from torchtex.sources import SourceField


@dataclass(frozen=True)
class Stage:
    """What `on_step` of a recipe is given.

    Args:
        done: share of the work that is done, in [0, 1].
        note: what goes on, in a few words; the same for all steps of one kind.
        texture: a preview, the pixels now.
        detail: more words, of this step alone.
    """

    done: float
    note: str
    texture: Float[Tensor, "c h w"]
    detail: str = ""


@dataclass(frozen=True)
class Montage:
    """A texture put together from patches.

    Args:
        texture: (c, h, w) in [0, 1].
        field: where every pixel came from; renders aligned maps.
        patches: number of the patch that each pixel belongs to, in the order of placing.
        seconds: of the whole run.
        seed: of the run.
        settings: plain values that describe the run.

    Example:
        >>> from torchtex.sources import copied
        >>> field = copied(torch.zeros(4, 4, 3, dtype=torch.long), ((8, 8),))
        >>> whole = Montage(torch.ones(1, 4, 4), field, torch.zeros(4, 4).long(), 0.1, 0, {})
        >>> whole.apply(torch.ones(2, 8, 8)).shape
        torch.Size([2, 4, 4])
    """

    texture: Float[Tensor, "c h w"]
    field: SourceField
    patches: Int[Tensor, "h w"]
    seconds: float
    seed: int
    settings: Mapping[str, Any]

    @property
    def source_map(self) -> Int[Tensor, "h w 3"]:
        """Exemplar, row and column of each pixel."""
        return self.field.source_map()

    @property
    def seams(self) -> Bool[Tensor, "h w"]:
        """True where a pixel's right or lower neighbor is of another patch."""
        return seams_between(self.patches)

    def apply(
        self, maps: Float[Tensor, "k _ _"] | Sequence[Float[Tensor, "k _ _"]]
    ) -> Float[Tensor, "k h w"]:
        """Renders maps aligned with the exemplars from the same places."""
        return self.field.apply(maps)

    def save(self, path: str | Path, *, bits: Literal[8, 16] = 8) -> None:
        """Writes the texture; a PNG also holds the settings, as JSON in the text chunk torchtex."""
        images.save(path, self.texture, bits=bits, metadata={"torchtex": json.dumps(self.report())})

    def report(self) -> dict[str, Any]:
        """Settings, seed and timing as plain values."""
        return {
            "seed": self.seed,
            "seconds": self.seconds,
            "settings": dict(self.settings),
            "patches": int(self.patches.max()) + 1,
        }

    def seam_picture(self) -> Float[Tensor, "3 h w"]:
        """The texture, paler, with the seams between patches in red."""
        return draw_seams(self.texture, self.seams)

    def patch_picture(self) -> Float[Tensor, "3 h w"]:
        """Every patch in a colour of its own."""
        return color_labels(self.patches)


def seams_between(labels: Int[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """True where the right or lower neighbor has another label.

    Example:
        >>> seams_between(torch.tensor([[0, 0, 1]])).tolist()
        [[False, True, False]]
    """
    seams = torch.zeros_like(labels, dtype=torch.bool)
    seams[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    seams[:-1] |= labels[:-1] != labels[1:]
    return seams


def draw_seams(texture: Float[Tensor, "c h w"], seams: Bool[Tensor, "h w"]) -> Tensor:
    """An RGB picture of a texture, paler, with seams in red.

    Example:
        >>> draw_seams(torch.zeros(1, 2, 2), torch.ones(2, 2, dtype=torch.bool))[:, 0, 0].tolist()
        [1.0, 0.0, 0.0]
    """
    rgb = texture if len(texture) == 3 else texture.mean(0, keepdim=True).expand(3, -1, -1)
    red = torch.tensor([1.0, 0.0, 0.0]).to(rgb)[:, None, None]
    return torch.where(seams, red, 0.3 + 0.7 * rgb)


def color_labels(labels: Int[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Labels as colours that differ for neighbors in number; -1, no label, is black.

    Example:
        >>> color_labels(torch.tensor([[0, 1]])).shape
        torch.Size([3, 1, 2])
    """
    golden = 0.61803398875
    hue = (labels.double() * golden % 1)[None] + torch.tensor([0.0, 1 / 3, 2 / 3])[:, None, None]
    color = 0.55 + 0.4 * torch.cos(2 * torch.pi * hue)
    return torch.where(labels < 0, 0.0, color).float()
