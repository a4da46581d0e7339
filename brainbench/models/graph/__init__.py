"""Temporal graphs: the specification, its nodes, unrolling over time, and import from PyTorchTNN."""
