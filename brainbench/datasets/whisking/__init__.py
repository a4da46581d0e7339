"""Training data: whisker sweeps in shards of ours, or in the files of the published study.

``dataset`` opens the shards and makes batches of them, or of published sweeps, in reused memory, and
``separability`` measures how well their classes are told apart.
"""
