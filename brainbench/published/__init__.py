"""Files and programs of published studies: an optional room, which nothing else imports.

``sweep_files`` reads the published sweeps, ``whiskit`` folders of WHISKiT Physics; ``conversion`` makes data sets and
stimulus sets of both, and ``commands`` is ``brainbench stimuli convert``.
"""
