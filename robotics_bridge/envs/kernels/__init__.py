"""Warp kernels of the environments."""
