"""Data sets of many sweeps: objects that brush past the whiskers under the conditions of a grid.

A grid and objects are ``sweep_scenes``; a ``plan`` cuts them into splits and shards; ``generation`` makes
the missing shards (``shards``: one HDF5 file each, layout in ``docs/datasets.md``) on a pool, a GPU or a cluster, and
writes the manifest. Shards are independent and renamed when complete, so a run that was killed goes on.
"""
