"""Training data: whisker sweeps in shards.

``files`` opens the shards, ``dataset`` makes batches of them in reused memory, and ``separability`` measures how
well their classes are told apart.
"""
