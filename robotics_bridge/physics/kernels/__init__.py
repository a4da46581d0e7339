"""Warp kernels that fill and check a hand state."""
