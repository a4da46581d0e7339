"""Warp kernels of noise."""
