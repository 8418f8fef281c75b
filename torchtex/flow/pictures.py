"""Pictures of flow fields: arrows, and streaks along the flow (line integral convolution)."""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchtex.flow.fields import check_fields, from_center
from torchtex.flow.warps import invert, sample
from torchtex.image import check_image, resize


def flow_picture(
    field: Float[Tensor, "2 h w"],
    *,
    kind: Literal["lic", "arrows", "both"] = "both",
    background: Float[Tensor, "c _ _"] | None = None,
    color: bool = False,
    periodic: bool = False,
    zoom: int = 1,
    spacing: int | None = None,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "3 y x"]:
    """A picture of a flow field, `zoom` times its size.

    It shows how pixels move as they pass: the mean of the displacement to the next frame and of
    that from the frame before. A displacement alone is the chord of a curve and leaves it, so
    that closed whirls would be spirals.

    Args:
        kind: streaks, arrows, or arrows over streaks. An arrow has its middle at its pixel; the
            fastest fills `spacing`.
        background: an image, one or three channels, under arrows; resized to the picture. With
            streaks it is lightened and darkened by them.
        color: hue shows the direction, saturation the speed.
        periodic: streaks go on at the other side.
        zoom: pixels of the picture per pixel of the field, at least 1.
        spacing: of the arrows, in pixels of the picture; None: a 13th of the longer side, at
            least 16.
        generator: of the noise under the streaks; None: the same noise each time.

    Raises:
        ValueError: no flow field, no image, or an argument out of range.

    Example:
        >>> flow_picture(torch.ones(2, 24, 16), kind="arrows", zoom=2).shape
        torch.Size([3, 48, 32])
    """
    check_fields(field, "field")
    if zoom < 1:
        raise ValueError(f"zoom={zoom} must be at least 1")
    if spacing is not None and spacing < 4:
        raise ValueError(f"spacing={spacing} must be at least 4 pixels, or None")
    large = _enlarged(_passing(field, periodic), zoom, periodic)
    h, w = large.shape[1:]
    if background is None:
        picture = field.new_full((3, h, w), 0.55 if kind == "arrows" else 0.5)
    else:
        check_image(background, "background")
        if background.shape[0] not in (1, 3):
            raise ValueError(f"background has {background.shape[0]} channels; give it 1 or 3")
        picture = resize(background.to(field), (h, w)).clamp(0, 1).expand(3, h, w)
    if color:
        tint = direction_colors(large)
        picture = tint if background is None else picture.mean(0, keepdim=True) * 0.5 + tint * 0.5
    if kind != "arrows":
        picture = _shaded(picture, _streaks(large, None, periodic, generator), large)
    if kind != "lic":
        picture = draw_arrows(picture, large, spacing=spacing)
    return picture.contiguous()


def lic(
    field: Float[Tensor, "2 h w"],
    *,
    length: float | None = None,
    periodic: bool = False,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "h w"]:
    """Line integral convolution: noise averaged along the curves of the flow, in [0, 1].

    Every pixel walks a pixel at a time both ways along the direction in which pixels pass, see
    `flow_picture` (midpoint rule), and averages what it meets under a Hann window. A second pass
    over the result makes the streaks longer and clearer. Mean 0.5, standard deviation about 0.2.

    Args:
        length: of the streaks in pixels; None: a 12th of the longer side, at least 10.
        periodic: walks go on at the other side; otherwise they end at the edges.
        generator: of the noise; None: the same noise each time.

    Raises:
        ValueError: no flow field, or a length below 1.

    Source: Cabral and Leedom 1993; Okada and Kao 1997, two passes.

    Example:
        >>> lic(torch.ones(2, 16, 16)).shape
        torch.Size([16, 16])
    """
    if length is not None and not 1 <= length < math.inf:
        raise ValueError(f"length={length} must be at least 1 pixel")
    return _streaks(_passing(field, periodic), length, periodic, generator)


def direction_colors(field: Float[Tensor, "2 h w"]) -> Float[Tensor, "3 h w"]:
    """Hue by direction (right red, up yellow-green, left cyan, down violet), saturation by speed.

    Example:
        >>> direction_colors(torch.zeros(2, 1, 1)).flatten().tolist()  # at rest: grey
        [0.75, 0.75, 0.75]
    """
    angle = torch.atan2(-field[0], field[1]).remainder(2 * math.pi)
    speed = field.square().sum(0).sqrt()
    share = (speed / speed.amax().clamp(min=1e-12)).sqrt() * 0.75
    # hsv by its formula: channel n falls off with the distance of the hue to its own
    sector = torch.tensor([5.0, 3.0, 1.0], dtype=field.dtype, device=field.device)[:, None, None]
    k = (sector + angle * (3 / math.pi)).remainder(6)
    fall = torch.minimum(k, 4 - k).clamp(0, 1)
    value = 0.75 + 0.15 * share
    return value - value * share * fall


def draw_arrows(
    image: Float[Tensor, "3 h w"],
    field: Float[Tensor, "2 h w"],
    *,
    spacing: int | None = None,
) -> Float[Tensor, "3 h w"]:
    """The image with white arrows, dark around the edge, on a regular lattice.

    Args:
        field: of the same size. Lengths are relative to the fastest; dots mark what rests.
        spacing: pixels between arrows; None: a 13th of the longer side, at least 16.

    Example:
        >>> draw_arrows(torch.zeros(3, 20, 20), torch.ones(2, 20, 20)).amax().item()
        1.0
    """
    _, h, w = field.shape
    step = max(16, max(h, w) // 13) if spacing is None else spacing
    rows, columns = max(1, round(h / step)), max(1, round(w / step))
    middle = from_center((0.0, 0.0), rows, columns)
    scale = torch.tensor([h / rows, w / columns], dtype=torch.float64)[:, None, None]
    middle = (middle * scale - 0.5).to(field.device)
    motion = sample(field.double(), middle, cubic=False)
    fastest = float(motion.square().sum(0).amax().sqrt())
    motion = motion / max(fastest, 1e-12) * (0.85 * min(h / rows, w / columns))
    distance = _arrow_distance(middle, motion, h, w)
    width = max(0.6, step / 28)
    edge = width + max(1.0, step / 22)
    dark = (edge + 0.5 - distance).clamp(0, 1).to(image.dtype)
    light = (width + 0.5 - distance).clamp(0, 1).to(image.dtype)
    return torch.lerp(image * (1 - 0.85 * dark), torch.ones_like(image), light)


def _arrow_distance(
    middle: Float[Tensor, "2 y x"], motion: Float[Tensor, "2 y x"], h: int, w: int
) -> Float[Tensor, "h w"]:
    """Distance of each pixel to the nearest arrow, of those in its own cell and around it."""
    here = from_center((0.0, 0.0), h, w).to(middle.device) - 0.5
    rows, columns = middle.shape[1:]
    cell = ((here[0] + 0.5) * rows / h).long(), ((here[1] + 0.5) * columns / w).long()
    nearest = torch.full_like(here[0], torch.inf)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            at = (cell[0] + i).clamp(0, rows - 1), (cell[1] + j).clamp(0, columns - 1)
            way = motion[:, at[0], at[1]]
            off = here - middle[:, at[0], at[1]]
            nearest = torch.minimum(nearest, _distance_to_arrow(off, way))
    return nearest


def _distance_to_arrow(off: Float[Tensor, "2 h w"], way: Float[Tensor, "2 h w"]) -> Tensor:
    """Distance to an arrow about 0, as long as `way`: a shaft, and a head of two strokes."""
    length = way.square().sum(0).sqrt()
    right = way.new_tensor([0.0, 1.0])[:, None, None]  # dots have no direction
    unit = torch.where(length > 1e-6, way / length.clamp(min=1e-6), right)
    along = unit[0] * off[0] + unit[1] * off[1]
    across = (unit[0] * off[1] - unit[1] * off[0]).abs()  # both strokes are mirror images
    beyond = (along.abs() - length / 2).clamp(min=0)
    shaft = (beyond.square() + across.square()).sqrt()
    back, side = along - length / 2, 0.3 * length
    reach = ((-back + 0.7 * across) / 1.49 / side.clamp(min=1e-9)).clamp(0, 1) * side
    head = ((back + reach).square() + (across - 0.7 * reach).square()).sqrt()
    return torch.minimum(shaft, head)


def _passing(field: Float[Tensor, "2 h w"], periodic: bool) -> Float[Tensor, "2 h w"]:
    """Velocity of what passes each pixel, halfway between where it comes from and where it goes."""
    return (field - invert(field, periodic=periodic)[0]) / 2


def _streaks(
    velocity: Float[Tensor, "2 h w"],
    length: float | None,
    periodic: bool,
    generator: torch.Generator | None,
) -> Float[Tensor, "h w"]:
    h, w = velocity.shape[1:]
    if length is None:
        length = max(10.0, max(h, w) / 12)
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    noise = torch.rand(1, h, w, generator=generator, dtype=torch.float64).to(velocity.device)
    flow = velocity.double()
    speed = flow.square().sum(0).sqrt()
    # directions shrink where the flow stands still, so that no walk jumps across the middle
    unit = flow / (speed + 1e-3 * speed.amax() + 1e-12)
    steps = max(1, round(length / 2))
    once = _convolved(noise, unit, steps, periodic)
    twice = _convolved(_contrast(once), unit, steps, periodic)
    return _contrast(twice)[0].clamp(0, 1).to(velocity.dtype)


def _convolved(
    image: Float[Tensor, "1 h w"], unit: Float[Tensor, "2 h w"], steps: int, periodic: bool
) -> Float[Tensor, "1 h w"]:
    _, h, w = unit.shape
    start = from_center((0.0, 0.0), h, w).to(unit.device) - 0.5
    total, weights = image.clone(), torch.ones_like(image[0])
    for sign in (1.0, -1.0):
        place, inside = start, torch.ones_like(weights)
        for step in range(1, steps + 1):
            half = place + sign / 2 * sample(unit, place, periodic=periodic, cubic=False)
            place = place + sign * sample(unit, half, periodic=periodic, cubic=False)
            if not periodic:
                row = (place[0] > -0.5) & (place[0] < h - 0.5)
                inside = inside * (row & (place[1] > -0.5) & (place[1] < w - 0.5))
            weight = inside * (0.5 + 0.5 * math.cos(math.pi * step / (steps + 1)))
            total = total + weight * sample(image, place, periodic=periodic, cubic=False)
            weights = weights + weight
    return total / weights


def _contrast(image: Float[Tensor, "1 h w"]) -> Float[Tensor, "1 h w"]:
    """Mean 0.5 and standard deviation 0.2, row sums first so that no thread count shows."""
    count = image.numel()
    centred = image - image.sum(-1).sum() / count
    spread = float((centred.square().sum(-1).sum() / count).sqrt())
    return 0.5 + centred * (0.2 / max(spread, 1e-9))


def _shaded(
    picture: Float[Tensor, "3 h w"], streaks: Float[Tensor, "h w"], field: Float[Tensor, "2 h w"]
) -> Float[Tensor, "3 h w"]:
    """The picture made darker and lighter by the streaks, less so where the flow is slow."""
    speed = field.square().sum(0).sqrt()
    strength = 0.35 + 0.65 * (4 * speed / speed.amax().clamp(min=1e-12)).clamp(max=1)
    shade = strength * (2 * streaks - 1)
    return (picture * (1 + 0.9 * shade)).clamp(0, 1)


def _enlarged(field: Float[Tensor, "2 h w"], zoom: int, periodic: bool) -> Float[Tensor, "2 y x"]:
    if zoom == 1:
        return field
    _, h, w = field.shape
    place = (from_center((0.0, 0.0), h * zoom, w * zoom) / zoom - 0.5).to(field.device)
    return sample(field, place, periodic=periodic, cubic=False)
