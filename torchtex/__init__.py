"""Textures by minimising energies: exemplar-based texture synthesis in PyTorch."""

__version__ = "0.1.0"
