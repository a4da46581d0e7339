"""Files and programs of published studies: an optional room, which nothing else imports.

``recordings`` reads and checks the published rates, ``whiskit`` folders of WHISKiT Physics; ``conversion`` reads the
published sweeps, and makes data sets and stimulus sets of both. ``checkpoint_import`` recognises the weights of the
published networks and makes them models, and ``readout`` reads a network's layers as the published scores did.
``commands`` is ``brainbench stimuli convert`` and ``brainbench models import``.
"""
