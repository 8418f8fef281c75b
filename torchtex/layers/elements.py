"""Elements of a texture: the flowers on a meadow, the olives on a plate, found one by one.

Colours are put into a few clusters. Every choice of clusters, as the colours of the elements, gives
regions, which are cut apart at their waists by a watershed of the distance to their borders. The
choice whose pieces are most like elements is kept: convex, of other colours than the ground, with
it rather than each other or the edge of the picture beside them, and not mere specks.

Source: the measure is ours; Meyer 1994 for the watershed, Shen et al. 2010 for what it is for.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchtex.extras import needed
from torchtex.image import check_image
from torchtex.quadratic import threads

_SAMPLES = 20000  # pixels that the clusters are found from
_LARGEST = 0.4  # share of the picture that one element may cover


@dataclass(frozen=True, eq=False)
class Elements:
    """Elements of a picture.

    Args:
        labels: 0 on the ground, k on the k-th element.

    Example:
        >>> found = Elements(torch.tensor([[0, 1, 1], [2, 0, 1]]))
        >>> found.count, found.areas.tolist(), found.whole().tolist()
        (2, [3, 1], [])
    """

    labels: Int[Tensor, "h w"]

    @property
    def count(self) -> int:
        """How many there are."""
        return int(self.labels.max())

    @property
    def areas(self) -> Int[Tensor, "n"]:
        """Pixels of each."""
        return torch.bincount(self.labels.flatten(), minlength=self.count + 1)[1:]

    @property
    def cover(self) -> float:
        """Share of the picture that they cover."""
        return float((self.labels > 0).double().mean())

    @property
    def typical(self) -> float:
        """Side of a square as large as most of what they cover: large ones count for more."""
        areas = self.areas.double()
        return float((areas.square().sum() / areas.sum()).sqrt()) if self.count else 0.0

    def mask(self, number: int) -> Bool[Tensor, "h w"]:
        """Pixels of one of them, counted from 1."""
        return self.labels == number

    def box(self, number: int) -> tuple[slice, slice]:
        """Rows and columns of one of them."""
        rows, cols = self.mask(number).nonzero().unbind(1)
        return (
            slice(int(rows.min()), int(rows.max()) + 1),
            slice(int(cols.min()), int(cols.max()) + 1),
        )

    def centers(self) -> Float[Tensor, "n 2"]:
        """Row and column of the middle of each."""
        rows, cols = (self.labels > 0).nonzero().unbind(1)
        index = self.labels[rows, cols] - 1
        sums = torch.zeros(self.count, 2, dtype=torch.float64)
        sums.index_add_(0, index, torch.stack([rows, cols], 1).double())
        return sums / self.areas[:, None]

    def picture(self, image: Float[Tensor, "c h w"]) -> Float[Tensor, "3 h w"]:
        """The image with the ground darkened and red lines between elements."""
        labels = self.labels.to(image.device)
        rgb = image if len(image) == 3 else image.mean(0, keepdim=True).expand(3, -1, -1)
        lines = torch.zeros_like(labels, dtype=torch.bool)
        lines[:, :-1] |= labels[:, :-1] != labels[:, 1:]
        lines[:-1] |= labels[:-1] != labels[1:]
        red = rgb.new_tensor([1.0, 0.0, 0.0])[:, None, None]
        return torch.where(lines, red, torch.where(labels > 0, rgb, 0.4 * rgb))

    def whole(self) -> Int[Tensor, "n"]:
        """Numbers of those that the edge of the picture does not cut off."""
        edge = torch.cat([self.labels[0], self.labels[-1], self.labels[:, 0], self.labels[:, -1]])
        every = torch.arange(1, self.count + 1)
        return every[~torch.isin(every, edge)]


def find_elements(
    image: Float[Tensor, "c h w"],
    mask: Bool[Tensor, "h w"] | None = None,
    *,
    at: tuple[int, int] | None = None,
    colors: int = 3,
    least: int | None = None,
    seed: int = 0,
) -> Elements:
    """The elements of a picture, by their colours, or those in a mask.

    Args:
        mask: True on all elements; they are only cut apart then.
        at: row and column of a pixel of one of them, where the choice of colours is a wrong one.
        colors: clusters, some of which are the elements.
        least: smallest element in pixels; of a thousandth of the picture unless given.
        seed: of the clusters.

    Raises:
        ValueError: no image, an option out of range, or no elements found.
        ImportError: scikit-image or scikit-learn is not installed, of the extra `design`.

    Example:
        >>> image = torch.zeros(3, 32, 32)
        >>> image[:, 4:12, 4:12] = image[0, 18:28, 16:26] = 1.0
        >>> find_elements(image).count
        2
    """
    check_image(image)
    h, w = image.shape[1:]
    if mask is not None and (tuple(mask.shape) != (h, w) or not bool(mask.any())):
        raise ValueError(
            f"mask has {int(mask.sum())} pixels in {tuple(mask.shape)}; mark the elements on a "
            f"mask of {h} x {w}"
        )
    if not 2 <= colors <= 6:
        raise ValueError(f"colors={colors} must lie in 2..6")
    if least is not None and least < 1:
        raise ValueError(f"least={least} must be at least 1 pixel")
    if at is not None and not (0 <= at[0] < h and 0 <= at[1] < w):
        raise ValueError(f"at={at} lies outside of the picture of {h} x {w} pixels")
    smallest = max(9, h * w // 1000) if least is None else least
    needed("sklearn", "elements")
    needed("skimage", "elements")
    if mask is not None:
        labels = _split(mask.cpu().numpy(), smallest)
        if not labels.max():
            raise ValueError(
                f"mask: no element of least={smallest} pixels or more; mark larger ones"
            )
        return Elements(torch.from_numpy(labels).long())
    best, found = 0.0, None
    seen = _colours(image)
    for region in _choices(_clusters(seen, colors, seed), colors):
        if at is not None and not region[at]:
            continue
        labels = _split(region, smallest)
        score = _likeness(labels, region, seen)
        if score > best:
            best, found = score, labels
    if found is None:
        raise ValueError(
            f"image: no elements of least={smallest} pixels found by colors={colors}; "
            "give a mask of them"
        )
    return Elements(torch.from_numpy(found).long())


def _colours(image: Tensor) -> NDArray[Any]:
    """(h, w, c): a little smoothed, in Lab where there are three channels."""
    from kornia.color import rgb_to_lab
    from kornia.filters import gaussian_blur2d

    with threads(1):
        soft = gaussian_blur2d(image.detach().cpu().double()[None], (5, 5), (1.0, 1.0))
        lab = rgb_to_lab(soft)[0] if len(image) == 3 else 100 * soft[0]
    return np.asarray(lab.permute(1, 2, 0).numpy())


def _clusters(seen: NDArray[Any], colors: int, seed: int) -> NDArray[Any]:
    """(h, w): number of the cluster of each pixel's colour."""
    from sklearn.cluster import KMeans

    pixels = seen.reshape(-1, seen.shape[2])
    step = max(1, len(pixels) // _SAMPLES)
    fitted = KMeans(colors, n_init=4, random_state=seed).fit(pixels[::step])
    return np.asarray(fitted.predict(pixels).reshape(seen.shape[:2]))


def _choices(clusters: NDArray[Any], colors: int) -> Iterator[NDArray[Any]]:
    """Every region that is made of some of the clusters, but not of all."""
    for count in range(1, colors):
        for chosen in itertools.combinations(range(colors), count):
            yield np.isin(clusters, chosen)


def _split(region: NDArray[Any], least: int) -> NDArray[Any]:
    """Labels of the pieces of a region, cut at waists; those that are too small are dropped."""
    from skimage.measure import label
    from skimage.morphology import h_maxima
    from skimage.segmentation import watershed

    ndimage = import_module("scipy.ndimage")  # comes with scikit-image, without types
    open_ = ndimage.binary_opening(region, iterations=1)
    clean = ndimage.binary_fill_holes(open_)
    if clean.mean() > 0.98:  # holes were all there was of a ground
        clean = open_
    depth = ndimage.distance_transform_edt(np.pad(clean, 1, mode="edge"))[1:-1, 1:-1]
    rise = max(0.75, 0.15 * math.sqrt(least))
    pieces = watershed(-depth, label(h_maxima(depth, rise)), mask=clean)
    areas = np.bincount(pieces.ravel())
    keep = areas >= least
    keep[0] = False
    number = np.cumsum(keep) * keep
    return np.asarray(number[pieces])


def _likeness(labels: NDArray[Any], region: NDArray[Any], seen: NDArray[Any]) -> float:
    """How much pieces are like elements, from 0 to 1."""
    from skimage.measure import regionprops

    count = int(labels.max())
    if not count or bool(labels.all()):
        return 0.0
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    if areas.max() > _LARGEST * labels.size:
        return 0.0
    solid = np.array([part.solidity for part in regionprops(labels)])
    share, covered = areas / areas.sum(), areas.sum() / labels.size
    alike = float((share * solid**2 * bounded(labels) ** 3).sum())
    pure = areas.sum() / max(region.sum(), areas.sum())
    return float(alike * pure * covered**0.25 * _contrast(labels > 0, seen))


def bounded(labels: NDArray[Any]) -> NDArray[Any]:
    """The part of each element's border that the ground is beyond.

    Example:
        >>> bounded(np.array([[0, 1, 2, 0]])).tolist()  # on three sides each is no ground
        [0.25, 0.25]
    """
    count = int(labels.max())
    wide = np.pad(labels, 1, constant_values=-1)
    ground, border = np.zeros(count + 1), np.zeros(count + 1)
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        beside = np.roll(wide, step, axis)[1:-1, 1:-1]
        edge = (beside != labels) & (labels > 0)
        border += np.bincount(labels[edge], minlength=count + 1)
        ground += np.bincount(labels[edge & (beside == 0)], minlength=count + 1)
    return np.asarray(ground[1:] / np.maximum(border[1:], 1))


def _contrast(inside: NDArray[Any], seen: NDArray[Any]) -> float:
    """How far the colours of elements are from those of the ground, for its spread; 0 to 1."""
    ground = seen[~inside]
    away = np.square(seen[inside] - ground.mean(0)).sum(1)
    return float((away / (away + ground.var(0).sum() + 1e-12)).mean())
