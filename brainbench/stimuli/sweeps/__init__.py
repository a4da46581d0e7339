"""Data sets of many sweeps: a plan of shards, shards written by a pool or a cluster, and a manifest of all.

A shard is one HDF5 file of some sweeps (layout: ``docs/datasets.md``). Shards are independent of one another: each is
written under a temporary name and renamed, so a run that was killed goes on with the shards that are missing.
"""
