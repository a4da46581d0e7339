"""Warp kernels of tasks that keep a state of their own."""
