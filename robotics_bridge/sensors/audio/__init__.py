"""Sound of contacts and drives: ``modes`` finds those of solids by finite elements, ``sensors`` holds materials and
configurations, ``runtime`` makes a block of samples per update, and sums what reaches a listener.
"""
