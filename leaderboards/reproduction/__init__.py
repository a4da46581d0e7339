"""A campaign of trainings held against the published study: which of its headlines hold on our stimuli.

:mod:`trainings` reads the lines of a campaign and :mod:`campaign` joins them with records; :mod:`measures` takes
accuracy, fit and order of layers from them, :mod:`contrasts` estimates differences with their intervals,
:mod:`comparisons` says what each published claim compares, :mod:`claims` judges it by a rule and :mod:`page` writes it
all down, with the figures of the board. The published numbers stand in ``published.json``.
"""
