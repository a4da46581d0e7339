"""Warp kernels of the taxels."""
