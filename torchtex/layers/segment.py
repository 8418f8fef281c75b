"""Layers of a texture: regions of one colour, gathered into a few layers, each with child layers.

Regions are found by mean shift in colour space, or by the efficient graph-based method, and their
mean colours are clustered. Layers need not be perfect: what is torn off is completed later. Where
they must be, scribbles or masks say so.

Needs the extra `design` (scikit-image, scikit-learn).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchtex.extras import needed
from torchtex.image import check_image

Method = Literal["meanshift", "graph"]
METHODS: tuple[Method, ...] = ("meanshift", "graph")
_SAMPLED = 1500  # pixels that mean shift climbs from
_QUANTILE = 0.15  # of the distances between pixels is the bandwidth
_LEAST = 1 / 400  # of the image: smaller pieces join what is around them


@dataclass(frozen=True)
class Segmentation:
    """Which layer, and which child of it, each pixel belongs to.

    Args:
        labels: layers 0, 1, ..., the largest first unless scribbles or masks say otherwise.
        children: pieces of layers, numbered over all of them; each is connected.

    Example:
        >>> made = Segmentation(torch.tensor([[0, 1, 0]]), torch.tensor([[0, 1, 2]]))
        >>> made.count, made.children_of(0)
        (2, [0, 2])
    """

    labels: Int[Tensor, "h w"]
    children: Int[Tensor, "h w"]

    @property
    def count(self) -> int:
        """Number of layers."""
        return int(self.labels.max()) + 1

    def mask(self, layer: int) -> Bool[Tensor, "h w"]:
        """True in a layer."""
        return self.labels == layer

    def children_of(self, layer: int) -> list[int]:
        """Numbers of the child layers, in the order of their first pixels."""
        return [int(n) for n in self.children[self.labels == layer].unique()]

    def picture(self, image: Float[Tensor, "c h w"], layer: int) -> Float[Tensor, "c1 h w"]:
        """A layer as a picture: the image, with one channel more that is 1 in the layer."""
        return torch.cat([image, self.mask(layer)[None].to(image)])


def segment(
    image: Float[Tensor, "c h w"],
    layers: int = 3,
    *,
    method: Method = "graph",
    smooth: float = 1.0,
    smallest: int | None = None,
    scribbles: Int[Tensor, "_ _"] | None = None,
    masks: Sequence[Bool[Tensor, "_ _"]] = (),
) -> Segmentation:
    """A texture cut into layers of like colours.

    Args:
        image: (c, h, w) in [0, 1]; colours are compared in CIE Lab.
        layers: how many; with scribbles or masks that is what they name.
        method: "meanshift" looks at colours alone, "graph" at how they differ from pixel to
            pixel, so its regions are objects rather than colours.
        smooth: sigma in pixels of a blur before it.
        smallest: pixels of the smallest piece; None for a 400th of the image.
        scribbles: number of the layer where a pixel is marked, and -1 elsewhere. A region goes to
            the layer that marks most of it, and others to that whose marked regions are nearest
            in colour.
        masks: True in the first layer, in the second, ...; where they overlap the later one
            counts, and what none covers is one layer more. Nothing is searched for then.

    Raises:
        ValueError: an option out of range, scribbles or masks that name one layer only, or an
            image that has fewer colours than layers.
        ImportError: without the extra `design`.

    Source: Comaniciu and Meer 2002; Felzenszwalb and Huttenlocher 2004; their use for layers, Shen
        et al. 2006, section 3.2.

    Example:
        >>> image = torch.zeros(1, 24, 24)
        >>> image[:, 8:16, 8:16] = 1
        >>> made = segment(image, 2)
        >>> int(made.mask(1).sum()), len(made.children_of(0))
        (64, 1)
    """
    check_image(image)
    size = (image.shape[1], image.shape[2])
    if masks:
        labels = _of_masks(masks, size)
        return _finished(labels, image.device)
    _check(image, layers, method, smooth, smallest, scribbles)
    colour = _colours(image, smooth)
    regions = _shifted(colour, layers) if method == "meanshift" else _graph(colour, size)
    mean, area = _means(colour, regions)
    if scribbles is not None:
        of_region = _scribbled(regions, mean, scribbles.cpu().numpy())
        layers = int(of_region.max()) + 1
    else:
        of_region = _clustered(mean, area, layers)
    labels = of_region[regions].reshape(size)
    least = round(_LEAST * labels.size) if smallest is None else smallest
    labels = _absorbed(labels, max(1, least))
    if scribbles is not None:
        labels = np.where(scribbles.cpu().numpy() >= 0, scribbles.cpu().numpy(), labels)
    else:
        order = np.argsort(-np.bincount(labels.ravel(), minlength=layers), kind="stable")
        labels = np.argsort(order)[labels]
    found = len(np.unique(labels))
    if found < 2:
        raise ValueError(
            f"layers={layers}: only one layer of pieces of {least} pixels or more was found; lower "
            "smallest, or mark layers with scribbles"
        )
    return _finished(np.unique(labels, return_inverse=True)[1].reshape(size), image.device)


def _colours(image: Tensor, smooth: float) -> NDArray[np.float64]:
    """(pixels, features): Lab, a hundredth of it, or the channels as they are."""
    x = image.detach().cpu().double()
    if smooth > 0:
        from kornia.filters import gaussian_blur2d

        width = 2 * round(2 * smooth) + 1
        sides = (width, width)
        x = gaussian_blur2d(x[None], sides, (smooth, smooth), border_type="replicate")[0]
    if len(x) == 3:
        from kornia.color import rgb_to_lab

        x = rgb_to_lab(x.clamp(0, 1)) / 100
    return x.flatten(1).T.contiguous().numpy()


def _shifted(colour: NDArray[np.float64], layers: int) -> NDArray[np.int64]:
    """The mode of colour that every pixel belongs to, by mean shift; at least `layers` of them."""
    cluster = needed("sklearn.cluster", "layers")
    some = colour[:: max(1, len(colour) // _SAMPLED)]
    quantile = _QUANTILE
    for _ in range(6):
        width = cluster.estimate_bandwidth(some, quantile=quantile)
        if width <= 0:
            break
        modes = cluster.MeanShift(bandwidth=width, bin_seeding=True).fit(some).cluster_centers_
        if len(modes) >= layers:
            apart = torch.cdist(torch.from_numpy(colour), torch.from_numpy(modes))
            return np.unique(apart.argmin(1).numpy(), return_inverse=True)[1]
        quantile /= 2
    # hardly any colours: each is a mode
    return np.unique(colour.round(3), axis=0, return_inverse=True)[1].ravel()


def _graph(colour: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.int64]:
    """Regions whose borders are stronger than what is inside them."""
    segmentation = needed("skimage.segmentation", "layers")
    if colour.shape[1] > 3:  # more than it takes: the axes that vary most
        centred = colour - colour.mean(0)
        colour = centred @ np.linalg.eigh(centred.T @ centred)[1][:, -3:]
    picture = colour.reshape(*size, -1)
    least = max(4, round(_LEAST / 2 * size[0] * size[1]))
    spread = float(picture.std(axis=(0, 1)).mean())
    regions = segmentation.felzenszwalb(
        picture / max(spread, 1e-6), scale=60, sigma=0, min_size=least, channel_axis=-1
    )
    return regions.ravel()


def _means(
    colour: NDArray[np.float64], regions: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    area = np.bincount(regions).astype(np.float64)
    sums = [np.bincount(regions, channel) for channel in colour.T]
    return np.stack(sums, 1) / area[:, None], area


def _clustered(
    mean: NDArray[np.float64], area: NDArray[np.float64], layers: int
) -> NDArray[np.int64]:
    """The layer of every region, by k-means of the mean colours."""
    different = len(np.unique(mean.round(6), axis=0))
    if different < layers:
        raise ValueError(
            f"layers={layers}: only {different} regions of different colours were found; choose "
            "fewer, or mark layers with scribbles"
        )
    means = needed("sklearn.cluster", "layers").KMeans(layers, n_init=4, random_state=0)
    return means.fit(mean, sample_weight=area).labels_.astype(np.int64)


def _scribbled(
    regions: NDArray[np.int64], mean: NDArray[np.float64], marks: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The layer that marks most of every region, else that of the marked region nearest to it."""
    marked = marks.ravel() >= 0
    votes = np.zeros((len(mean), int(marks.max()) + 1))
    np.add.at(votes, (regions[marked], marks.ravel()[marked]), 1)
    known = votes.any(1)
    apart = np.square(mean[:, None] - mean[known][None]).sum(-1)
    return votes.argmax(1)[known][apart.argmin(1)]


def _absorbed(labels: NDArray[np.int64], least: int) -> NDArray[np.int64]:
    """Labels without pieces of fewer pixels: those take the label next to them."""
    pieces = needed("skimage.measure", "layers").label(labels + 1, connectivity=1)
    area = np.bincount(pieces.ravel())
    small = area[pieces] < least
    if not small.any() or small.all():
        return labels
    expand = needed("skimage.segmentation", "layers").expand_labels
    return expand(np.where(small, 0, labels + 1), distance=sum(labels.shape)) - 1


def _of_masks(masks: Sequence[Tensor], size: tuple[int, int]) -> NDArray[np.int64]:
    labels = np.full(size, len(masks))
    for number, mask in enumerate(masks):
        if mask.shape != size:
            raise ValueError(
                f"mask of layer {number + 1} is {mask.shape[0]}x{mask.shape[1]} and image "
                f"{size[0]}x{size[1]}; give both one size"
            )
        labels[mask.cpu().numpy()] = number
    missing = sorted(set(range(len(masks))) - set(np.unique(labels).tolist()))
    if missing:
        raise ValueError(
            f"mask of layer {missing[0] + 1} is empty, or later ones cover all of it; widen it"
        )
    if len(np.unique(labels)) < 2:
        raise ValueError("masks name one layer only, all of the image; leave some of it out")
    return labels


def _finished(labels: NDArray[np.int64], device: torch.device) -> Segmentation:
    pieces = needed("skimage.measure", "layers").label(labels + 1, connectivity=1) - 1
    made = (torch.from_numpy(x.astype(np.int64)).to(device) for x in (labels, pieces))
    return Segmentation(*made)


def _check(
    image: Tensor, layers: int, method: str, smooth: float, smallest: int | None,
    scribbles: Tensor | None,
) -> None:  # fmt: skip
    if method not in METHODS:
        raise ValueError(f"method={method!r} is unknown; choose {', '.join(METHODS)}")
    if not 0 <= smooth <= 20:
        raise ValueError(f"smooth={smooth} must lie in 0..20 pixels")
    if smallest is not None and smallest < 1:
        raise ValueError(f"smallest={smallest} must be at least 1 pixel")
    if scribbles is None:
        if not 2 <= layers <= 64:
            raise ValueError(f"layers={layers} must lie in 2..64: one layer is the image itself")
        return
    if scribbles.shape != image.shape[1:]:
        raise ValueError(
            f"scribbles are {scribbles.shape[0]}x{scribbles.shape[1]} and image "
            f"{image.shape[1]}x{image.shape[2]}; give both one size"
        )
    named = scribbles[scribbles >= 0].unique()
    if len(named) < 2:
        raise ValueError(f"scribbles name {len(named)} layer; mark at least two")
    if int(named[-1]) != len(named) - 1:
        raise ValueError(
            f"scribbles name layers up to {int(named[-1])} and leave some out; number them 0, 1, 2"
        )
