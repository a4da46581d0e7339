"""Warp kernels of the temperature grid."""
