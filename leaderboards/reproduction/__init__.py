"""A campaign of trainings held against the published study: which of its headlines hold on our stimuli.

:mod:`campaign` reads trainings and records and joins them, :mod:`contrasts` estimates differences of networks with
their intervals, :mod:`claims` judges every published claim by a rule, :mod:`figures` draws figures 3.3 to 3.8 and
:mod:`page` writes it all down. The published numbers stand in ``published.json``.
"""
