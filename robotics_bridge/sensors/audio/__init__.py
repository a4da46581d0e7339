"""Sound of contacts and drives: ``modes`` finds those of solids by finite elements on ``tetrahedra``, ``sensors`` holds
the configurations, ``runtime`` makes a block of samples per update, ``microphone`` sums what reaches a listener.
"""
