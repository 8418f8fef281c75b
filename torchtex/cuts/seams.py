"""Seams: where one picture passes into another, by min-cut.

The cost of a seam between neighbouring pixels s (of picture A) and t (of picture B) is

    M(s, t, A, B) = |A(s) - B(s)| + |A(t) - B(t)|

A canvas that is made of many patches is kept as its *views*, a (5, c, h, w) tensor: what the
patch that owns a pixel shows at the pixel itself, and below, to the right, above and to the left
of it. The cost of each present seam follows from the views, and pasting is one `torch.where`:

    views = patch_views(exemplar)                               # once
    new = views[..., i : i + h, j : j + w]
    labels = cut_patch(old, new, first, second)                 # old: the same part of the canvas
    old.copy_(torch.where(labels, new, old))

Masks say `True` for the second picture, as the labels of a min-cut do.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from torchtex.cuts.mincut import MinCut, cut_grid
from torchtex.quadratic import rowwise_sum

FLOOR = 0.01  # added to the gradients, so that flat ground makes a seam dear but not infinite


def seam_costs(
    a: Float[Tensor, "c h w"],
    b: Float[Tensor, "c h w"],
    *,
    gradient: bool = False,
    wrap: tuple[bool, bool] = (False, False),
) -> tuple[Float[Tensor, "h w_"], Float[Tensor, "h_ w"]]:
    """M(s, t) from every pixel to its right neighbour, and to that below.

    Args:
        gradient: divide by the gradients of both pictures along the edge, at both its pixels,
            so that seams follow edges. A gradient is taken as the difference of the two pixels.
        wrap: (rows, columns) that are periodic; the last one then has a neighbour, the first.

    Source: Kwatra et al. 2003, Graphcut Textures, equations 1 and 5.

    Example:
        >>> right, down = seam_costs(torch.zeros(1, 2, 3), torch.ones(1, 2, 3))
        >>> right.tolist(), down.shape
        ([[2.0, 2.0], [2.0, 2.0]], torch.Size([1, 3]))
    """
    apart = _norm(a - b)
    costs = []
    for axis in (0, 1):
        cost = apart + apart.roll(-1, axis)
        if gradient:
            slopes = [_norm(x.roll(-1, axis + 1) - x) for x in (a, b)]
            cost = _weighed(cost, slopes[0], slopes[1])
        costs.append(cost if wrap[axis] else _starts(cost, axis))
    return costs[1], costs[0]


def cut_seam(
    right: Float[Tensor, "h w_ *directed"],
    down: Float[Tensor, "h_ w *directed"],
    first: Bool[Tensor, "h w"],
    second: Bool[Tensor, "h w"],
    *,
    unary: Float[Tensor, "h w 2"] | None = None,
    solver: MinCut | None = None,
) -> Bool[Tensor, "h w"]:
    """The cheapest seam between the pixels of the first picture and those of the second.

    Args:
        right, down: costs as of `seam_costs`; as many columns (rows) as the image has close the
            seam around a tube. With a last axis of 2: costs of the labels (0, 1) and (1, 0).
        first, second: pixels that must show the first (False) and the second picture (True).
        unary: further cost of the first and the second picture at each pixel.
        solver: None for the first one that is installed.

    Raises:
        ValueError: a pixel is forced to both, or costs and shapes make no sense.

    Example:
        >>> right, down = torch.tensor([[3.0, 1.0, 2.0]]), torch.zeros(0, 4)
        >>> ends = torch.tensor([[True, False, False, False]])
        >>> cut_seam(right, down, ends, ends.flip(1)).tolist()
        [[False, False, True, True]]
    """
    forced = _forced(right, first, second)
    return cut_grid(
        forced if unary is None else forced + unary,
        right if right.ndim == 3 else right[..., None].expand(-1, -1, 2),
        down if down.ndim == 3 else down[..., None].expand(-1, -1, 2),
        solver,
    )


def seam_energy(
    labels: Bool[Tensor, "h w"], right: Float[Tensor, "h w_"], down: Float[Tensor, "h_ w"]
) -> Float[Tensor, ""]:
    """Sum of the costs along the border between False and True.

    Example:
        >>> labels = torch.tensor([[False, True]])
        >>> seam_energy(labels, torch.tensor([[3.0]]), torch.zeros(0, 2)).item()
        3.0
    """
    total = right.new_zeros(())
    for axis, cost in ((1, right), (0, down)):
        cut = (labels ^ labels.roll(-1, axis)).narrow(axis, 0, cost.shape[axis])
        total = total + rowwise_sum(torch.where(cut, cost, torch.zeros_like(cost)).flatten())
    return total


def patch_views(patch: Float[Tensor, "c h w"]) -> Float[Tensor, "5 c h w"]:
    """What a patch shows at each pixel and below, right, above and left of it.

    Outside the patch its border goes on. Take the views of a whole exemplar once and crop them:
    then a patch knows what lies beyond its border.

    Example:
        >>> patch_views(torch.tensor([[[1.0, 2.0]]]))[2].tolist()  # to the right
        [[[2.0, 2.0]]]
    """
    h, w = patch.shape[1:]
    wide = pad(patch[None], (1, 1, 1, 1), mode="replicate")[0]
    corners = ((1, 1), (2, 1), (1, 2), (0, 1), (1, 0))
    return torch.stack([wide[:, i : i + h, j : j + w] for i, j in corners])


def present_seams(
    views: Float[Tensor, "5 c h w"], *, gradient: bool = False
) -> tuple[Float[Tensor, "h w_"], Float[Tensor, "h_ w"]]:
    """Costs M(s, t, A_s, A_t) of the seams that a canvas has; 0 inside a patch.

    Example:
        >>> right, down = present_seams(patch_views(torch.rand(3, 4, 5)))
        >>> right.shape, down.shape, right.max().item()
        (torch.Size([4, 4]), torch.Size([3, 5]), 0.0)
    """
    return _present(views, 1, gradient), _present(views, 0, gradient)


def cut_patch(
    old: Float[Tensor, "5 c h w"],
    new: Float[Tensor, "5 c h w"],
    first: Bool[Tensor, "h w"],
    second: Bool[Tensor, "h w"],
    *,
    gradient: bool = False,
    unary: Float[Tensor, "h w 2"] | None = None,
    solver: MinCut | None = None,
) -> Bool[Tensor, "h w"]:
    """Which pixels of a canvas a new patch should cover, its older seams taken into account.

    The labels minimise what `present_seams` of the result adds up to in this rectangle: seams
    of the old canvas that the new patch covers are gone, new ones appear around it.

    A pair of pixels of two old patches costs M(s, t, A_s, A_t) when both stay, M(s, t, A_s, B)
    or M(s, t, B, A_t) when one changes, and nothing when both do. By the triangle inequality
    of M this is submodular: the seam nodes of the paper can be solved for, and the graph
    stays a grid. With `gradient` that inequality may fail; the cost of the old seam is then
    counted only up to the sum of the two others.

    Args:
        old: views of the canvas in the rectangle; of no matter where it is empty.
        new: views of the new patch.
        first: pixels that must stay, as a rule those at the border of the rectangle whose
            neighbours outside it are not empty.
        second: pixels that must be new: the empty ones, and perhaps those around a bad seam.
        gradient: as in `seam_costs`.
        unary: further cost of staying and of being new.
        solver: None for the first one that is installed.

    Returns:
        True where the new patch goes.

    Raises:
        ValueError: a pixel is forced to both, or the numbers make no sense.

    Source: Kwatra et al. 2003, Graphcut Textures, section 4.

    Example:
        >>> old, new = patch_views(torch.rand(3, 8, 9)), patch_views(torch.rand(3, 8, 9))
        >>> first = torch.zeros(8, 9, dtype=torch.bool)
        >>> first[:, 0] = True
        >>> labels = cut_patch(old, new, first, first.flip(1))
        >>> canvas = torch.where(labels, new, old)
        >>> canvas[0].shape, bool(labels[:, 0].any()), bool(labels[:, 8].all())
        (torch.Size([3, 8, 9]), False, True)
    """
    costs = _forced(old, first, second)
    apart = _norm(old - new)
    edges = []
    for axis in (0, 1):
        ahead, back = 1 + axis, 3 + axis
        leave = _starts(apart[0] + apart[ahead], axis)  # s stays, t is new
        enter = _ends(apart[0] + apart[back], axis)  # s is new, t stays
        if gradient:
            slope = _starts(_norm(new[ahead] - new[0]), axis)
            leave = _weighed(leave, _starts(_norm(old[ahead] - old[0]), axis), slope)
            enter = _weighed(enter, _ends(_norm(old[0] - old[back]), axis), slope)
        stay = torch.minimum(_present(old, axis, gradient), leave + enter)
        # each of both pixels pays a part of the old seam when it stays, no more than the cost
        # of the pair that it stays in: what is left is a cost of unlike labels alone
        part = torch.minimum(torch.maximum(stay / 2, stay - enter), leave)
        _starts(costs[..., 0], axis).add_(part)
        _ends(costs[..., 0], axis).add_(stay - part)
        edges.append(torch.stack([leave - part, (enter - (stay - part)).clamp_min(0)], -1))
    return cut_grid(costs if unary is None else costs + unary, edges[1], edges[0], solver)


def _norm(x: Tensor) -> Tensor:
    return x.square().sum(-3).sqrt()


def _starts(x: Tensor, axis: int) -> Tensor:
    """The first pixel of every pair along an axis of the image."""
    return x.narrow(axis - 2, 0, x.shape[axis - 2] - 1)


def _ends(x: Tensor, axis: int) -> Tensor:
    """The second pixel of every pair."""
    return x.narrow(axis - 2, 1, x.shape[axis - 2] - 1)


def _weighed(cost: Tensor, slope: Tensor, other: Tensor) -> Tensor:
    return cost / (2 * (slope + other) + FLOOR)  # each gradient counts at both pixels


def _present(views: Tensor, axis: int, gradient: bool) -> Tensor:
    ahead, back = 1 + axis, 3 + axis
    here, there = _starts(views, axis), _ends(views, axis)
    cost = _norm(here[0] - there[back]) + _norm(here[ahead] - there[0])
    if gradient:
        cost = _weighed(cost, _norm(here[ahead] - here[0]), _norm(there[0] - there[back]))
    return cost


def _forced(like: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Costs (h, w, 2) that are infinite for the label that a pixel must not have."""
    both = int((first & second).sum())
    if both:
        raise ValueError(
            f"first and second share {both} pixels; each may be forced to one picture only"
        )
    forced = torch.stack([second, first], -1)
    return like.new_zeros(forced.shape).masked_fill_(forced, torch.inf)
