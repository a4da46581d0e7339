"""Warp kernels of the whisker solver. Units: mg, mm, ms, mN, µN·m."""
