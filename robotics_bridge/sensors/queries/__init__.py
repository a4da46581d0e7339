"""Geometry that sensors ask for: ``solids`` with distance fields and surface points, ``pairs`` of links and solids.

An update lists pairs first; kernels of sensors then ask the solids of each pair.
"""
