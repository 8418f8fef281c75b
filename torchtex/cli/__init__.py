"""The command line: parses, calls one recipe, shows; no numerics.

Nothing heavy is imported at the top of these modules, so that `torchtex --help` answers at once.
"""

# each module adds its commands to `app`, in the order that --help lists them
from torchtex.cli import synth, apply, repeat, measure, cutting, patches, tiles  # isort: skip  # noqa: F401
from torchtex.cli import edits, guided, moving, analogies  # isort: skip  # noqa: F401
from torchtex.cli import elements, marbling, rendering, solids  # isort: skip  # noqa: F401
from torchtex.cli import layers, completing, designing  # isort: skip  # noqa: F401
from torchtex.cli import skeletal, carving  # isort: skip  # noqa: F401
from torchtex.cli.base import app, main

__all__ = ["app", "main"]
