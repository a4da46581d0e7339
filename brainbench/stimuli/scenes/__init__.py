"""Scenes: a whisker array, its motion, the objects in its way, and the times at which forces are read.

A name goes through ``recipes``, a TOML file through ``scene_files``, to a ``scene``, whose frames say how forces are
read. Engines take its jobs.
"""
