"""Nearest neighborhoods: exact and approximate search, and search that leaves no key unused."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchtex.quadratic import threads


@runtime_checkable
class Index(Protocol):
    """Keys made ready for search: squared distances and labels, nearest first."""

    def search(
        self, queries: Float[Tensor, "n d"], k: int
    ) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]: ...


@runtime_checkable
class Matcher(Protocol):
    """Settings of a search; `fit` is called once per level."""

    def fit(self, keys: Float[Tensor, "m d"]) -> Index: ...


@dataclass(frozen=True)
class Chunked:
    """Exact search as chunked matrix products in torch: any device, any floating dtype.

    Args:
        chunk: queries at a time; chunk x m distances are held in memory.

    Example:
        >>> keys = torch.eye(4)
        >>> distances, labels = Chunked().fit(keys).search(keys[1:2], 1)
        >>> labels.tolist()
        [[1]]
    """

    chunk: int = 2048

    def fit(self, keys: Float[Tensor, "m d"]) -> "ChunkedIndex":
        return ChunkedIndex(keys, keys.square().sum(1), self.chunk)


@dataclass(frozen=True)
class ChunkedIndex:
    """The `Index` of `Chunked`."""

    keys: Tensor
    norms: Tensor
    chunk: int

    def search(
        self, queries: Float[Tensor, "n d"], k: int
    ) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
        found = [_topk(part, k) for part in _distances(queries, self.keys, self.norms, self.chunk)]
        return torch.cat([f[0] for f in found]), torch.cat([f[1] for f in found])


@dataclass(frozen=True)
class Exact:
    """Exact search by faiss on the CPU, in float32.

    Example:
        >>> Exact().fit(torch.eye(4)).search(torch.eye(4), 1)[1].flatten().tolist()
        [0, 1, 2, 3]
    """

    def fit(self, keys: Float[Tensor, "m d"]) -> "FaissIndex":
        faiss = faiss_library()
        index = faiss.IndexFlatL2(keys.shape[1])
        index.add(_array(keys))
        return FaissIndex(index, keys)


@dataclass(frozen=True)
class Clustered:
    """Approximate search by faiss in the few clusters nearest to a query (an inverted file).

    Args:
        clusters: number of k-means clusters; None for about 2 sqrt(m).
        probes: clusters searched per query.
        least: with fewer keys than this the search is exact, since clustering would cost more.

    Example:
        >>> index = Clustered(clusters=4, least=0).fit(torch.rand(500, 8))
        >>> index.search(torch.rand(3, 8), 2)[1].shape
        torch.Size([3, 2])
    """

    clusters: int | None = None
    probes: int = 8
    least: int = 5000

    def __post_init__(self) -> None:
        if self.clusters is not None and self.clusters < 1:
            raise ValueError(f"clusters={self.clusters} must be at least 1, or None")
        if self.probes < 1:
            raise ValueError(f"probes={self.probes} must be at least 1")

    def fit(self, keys: Float[Tensor, "m d"]) -> "FaissIndex":
        m, d = keys.shape
        if m < self.least:
            return Exact().fit(keys)
        faiss = faiss_library()
        clusters = min(m, self.clusters or max(1, round(2 * m**0.5)))
        quantizer = faiss.IndexFlatL2(d)
        index = faiss.IndexIVFFlat(quantizer, d, clusters)
        index.cp.seed, index.cp.niter, index.cp.max_points_per_centroid = 1234, 6, 40
        index.cp.min_points_per_centroid = 1
        index.train(_array(keys))
        index.add(_array(keys))
        index.nprobe = min(self.probes, clusters)
        return FaissIndex(index, keys)


@dataclass(frozen=True)
class FaissIndex:
    """The `Index` of `Exact` and `Clustered`.

    faiss is float32, so the distances are computed again in the dtype of the queries.
    """

    index: Any
    keys: Tensor

    def search(
        self, queries: Float[Tensor, "n d"], k: int
    ) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
        k = min(k, len(self.keys))
        near, found = self.index.search(_array(queries), k)
        labels = torch.from_numpy(found).to(queries.device)
        # a probed cluster may hold fewer than k keys
        labels = torch.where(labels < 0, labels[:, :1], labels).clamp_(min=0)
        if queries.dtype == torch.float32:
            return torch.from_numpy(near).to(queries.device), labels
        squared = torch.stack(
            [(queries - self.keys[labels[:, j]]).square().sum(1) for j in range(k)], 1
        )
        squared, order = squared.sort(dim=1, stable=True)
        return squared, labels.gather(1, order)


def faiss_library() -> Any:
    """faiss, with as many threads as torch has.

    Example:
        >>> faiss_library().omp_get_max_threads() == torch.get_num_threads()
        True
    """
    import faiss  # after torch, so that one OpenMP runtime is already in place

    faiss.omp_set_num_threads(torch.get_num_threads())
    return faiss


def two_sided_minima(
    queries: Float[Tensor, "n d"], keys: Float[Tensor, "m d"], *, chunk: int = 4096
) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"], Float[Tensor, "m"]]:
    """Nearest key of every query, and distance from every key to its nearest query.

    One pass over the distance matrix, `chunk` queries at a time, serves both directions.

    Returns:
        Squared distance of each query to its nearest key, the index of that key, and the
        squared distance of each key to its nearest query.

    Example:
        >>> two_sided_minima(torch.zeros(1, 2), torch.tensor([[0.0, 1.0], [2.0, 0.0]]))[2].tolist()
        [1.0, 4.0]
    """
    used = queries.new_full((len(keys),), float("inf"))
    best, labels = [], []
    for squared in _distances(queries, keys, keys.square().sum(1), chunk):
        near, label = squared.min(1)
        best.append(near)
        labels.append(label)
        used = torch.minimum(used, squared.amin(0))
    return torch.cat(best), torch.cat(labels), used


def complete_search(
    queries: Float[Tensor, "n d"],
    keys: Float[Tensor, "m d"],
    k: int,
    *,
    alpha: float,
    chunk: int = 2048,
) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Labels by distance relative to how well a key is already served: no key stays unused.

    score(q, k) = |q - k|^2 / (alpha * median + min over q' of |q' - k|^2)

    where the median is that of the denominators' minima. A key that some query already matches
    is dear, a key that nobody comes near is cheap, so lost features of the exemplar return.

    Returns:
        Scores and labels of the best k keys of each query, best first.

    Source: the normalisation of bidirectional similarity in Granot et al. 2022 (GPNN), after
    Simakov et al. 2008.

    Example:
        >>> complete_search(torch.rand(9, 2), torch.rand(5, 2), 1, alpha=0.1)[1].shape
        torch.Size([9, 1])
    """
    chunk = max(16, min(chunk, 2**21 // len(keys)))  # distances that stay in the cache
    norms = keys.square().sum(1)
    used = queries.new_full((len(keys),), float("inf"))
    for squared in _distances(queries, keys, norms, chunk):
        used = torch.minimum(used, squared.amin(0))
    tiny = torch.finfo(queries.dtype).tiny
    price = 1 / (used + alpha * used.median() + tiny)
    found = []
    for squared in _distances(queries, keys, norms, chunk):
        found.append(_topk(squared.mul_(price), k))
    return torch.cat([f[0] for f in found]), torch.cat([f[1] for f in found])


def principal_axes(
    sample: Float[Tensor, "m d"], count: int, generator: torch.Generator
) -> Float[Tensor, "d q"]:
    """Orthonormal directions that hold most of the variance of a sample, by subspace iteration.

    Example:
        >>> principal_axes(torch.rand(50, 8), 3, torch.Generator().manual_seed(0)).shape
        torch.Size([8, 3])
    """
    d = sample.shape[1]
    centred = sample - sample.mean(0)
    start = torch.randn(d, min(count, d), generator=generator, dtype=torch.float64)
    axes = _orthonormal(start.to(sample))
    for _ in range(4):
        axes = _orthonormal(centred.T @ (centred @ axes))
    return axes


def _orthonormal(x: Tensor) -> Tensor:
    with threads(1):  # LAPACK's QR gives other bits with more
        return torch.linalg.qr(x)[0]


def _distances(queries: Tensor, keys: Tensor, norms: Tensor, chunk: int) -> Iterator[Tensor]:
    # |q - k|^2 = |q|^2 + |k|^2 - 2 q.k, in one fused product
    for part in queries.split(chunk):
        squared = torch.addmm(norms, part, keys.T, alpha=-2)
        yield squared.add_(part.square().sum(1, keepdim=True)).clamp_(min=0)


def _topk(scores: Tensor, k: int) -> tuple[Tensor, Tensor]:
    if k == 1:
        best, labels = scores.min(1, keepdim=True)
        return best, labels
    best, labels = scores.topk(min(k, scores.shape[1]), dim=1, largest=False)
    return best, labels


def _array(x: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(x.detach().cpu().numpy(), dtype=np.float32)
