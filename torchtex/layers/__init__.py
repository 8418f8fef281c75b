"""Layers of a texture: segmented, deformed, arranged by chaotic maps, stitched, marbled."""
