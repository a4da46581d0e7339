"""Files and programs of published studies: an optional room, which nothing else imports.

``recordings`` reads and checks the published rates, ``sweep_files`` the published sweeps, ``whiskit`` folders of
WHISKiT Physics; ``conversion`` makes data sets and stimulus sets of both, and ``commands`` is
``brainbench stimuli convert``.
"""
