"""Files and programs of published studies: an optional room, which nothing else imports.

``recordings`` reads and checks the published rates, ``sweep_files`` the published sweeps, ``whiskit`` folders of
WHISKiT Physics; ``conversion`` makes data sets and stimulus sets of both. ``checkpoint_files`` recognises the weights
of the published networks, ``checkpoint_import`` makes them models, and ``readout`` reads a network's layers as the
published scores did. ``commands`` is ``brainbench stimuli convert`` and ``brainbench models import``.
"""
