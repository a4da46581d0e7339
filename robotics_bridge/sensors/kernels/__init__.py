"""Warp functions that all sensors share."""
