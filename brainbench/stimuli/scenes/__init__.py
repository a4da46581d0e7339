"""Scenes: a whisker array, its motion, the objects in its way, and the times at which forces are read.

A name goes through ``recipes``, a TOML file through ``scene_files`` (with ``motion_tables``, ``object_tables`` and
their reader ``toml_tables``) to a ``scene``, whose ``frames`` say how forces are read. Engines take its jobs.
"""
