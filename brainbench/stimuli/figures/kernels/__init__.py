"""Kernels of pictures: rays against the triangles of a scene."""
