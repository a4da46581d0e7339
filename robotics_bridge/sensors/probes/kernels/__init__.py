"""Warp kernels of the probes."""
