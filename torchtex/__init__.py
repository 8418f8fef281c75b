"""Textures by minimising energies: exemplar-based texture synthesis in PyTorch.

Names are loaded when they are first used, so that the command line starts quickly.
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
