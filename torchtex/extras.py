"""Packages that only some of torchtex needs: imported when asked for, or named with their extra."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

EXTRAS = {
    "plot": {"matplotlib": "matplotlib"},
    "video": {"imageio_ffmpeg": "imageio-ffmpeg"},
    "graphcut": {"maxflow": "PyMaxflow", "ortools": "OR-Tools"},
    "design": {"skimage": "scikit-image", "sklearn": "scikit-learn", "yaml": "PyYAML"},
    "solid": {"trimesh": "trimesh", "zarr": "zarr"},
}
"""The packages of every extra: what is imported, and what it is called."""


def needed(module: str, by: str, *, otherwise: str = "") -> Any:
    """A module of an optional package.

    Args:
        module: full name, such as "sklearn.cluster"; its package is one of `EXTRAS`.
        by: what needs it, for the error: a parameter or an operation.
        otherwise: what can be done without it, for the end of the error.

    Raises:
        ImportError: it is not installed; the sentence names the extra that brings it.

    Example:
        >>> needed("maxflow.vision", "cut=mincut", otherwise="choose cut=dp")
        Traceback (most recent call last):
        ImportError: cut=mincut: PyMaxflow is not installed; pip install 'torchtex[graphcut]'
    """
    try:
        return import_module(module)
    except ImportError as error:
        root = module.split(".")[0]
        extra, package = next((e, names[root]) for e, names in EXTRAS.items() if root in names)
        remedy = f"pip install 'torchtex[{extra}]'" + (f", or {otherwise}" if otherwise else "")
        raise ImportError(f"{by}: {package} is not installed; {remedy}") from error


def installed(extra: str) -> bool:
    """Whether all packages of an extra are there; none of them is imported.

    Example:
        >>> installed("plot") in (True, False)
        True
    """
    return all(find_spec(module) is not None for module in EXTRAS[extra])
