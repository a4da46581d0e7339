"""Warp functions of distances and contact pairs."""
