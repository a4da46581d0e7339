"""The life of a run, in one folder, the same for every training.

A run enters itself into its :mod:`.folder`, or finds itself there; it goes on from its state, writes its :mod:`.log`,
and ends early when it is told to. Started again it goes on exactly where it stood. Independent pieces of work run side
by side by :mod:`.jobs`.
"""
