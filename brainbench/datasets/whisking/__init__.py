"""Training data: whisker sweeps in shards of ours, or in the files of the published study.

``files`` opens the shards, ``sweep_files`` and ``sweep_tree`` the published sweeps; ``dataset`` makes batches of either
in reused memory, and ``separability`` measures how well their classes are told apart.
"""
