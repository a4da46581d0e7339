"""Warp kernels of the environment: torques of imperfect actuators, and net contact forces on links."""
