"""Sound of contacts and drives: ``modes`` finds those of solids by finite elements, ``sensors`` holds materials and
configurations, ``runtime`` makes a block of samples per update, ``microphone`` sums what reaches a listener.
"""
