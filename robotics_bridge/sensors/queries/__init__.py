"""Geometry that sensors ask for: ``solids`` with their distance fields, ``pairs`` of links and geometries, and
``surface_points``. An update lists pairs first; kernels of sensors then ask the solids of each pair.
"""
