"""Warp kernels of sound."""
