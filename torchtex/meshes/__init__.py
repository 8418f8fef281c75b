"""Meshes: shapes by name, files, smaller triangles, and places on textures."""
