"""Reliability of the animals' RDMs: split halves, noise correction, ceilings, units."""
