"""Volumes of colour: their files, slices and histograms, and meshes carved from them."""
