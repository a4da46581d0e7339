"""Warp kernels of the elastomer."""
