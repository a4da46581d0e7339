"""Tests of the kernels: on a GPU, or by Triton's interpreter where there is none."""
