"""Motion of whiskers, heads and objects.

``trajectories`` holds motions that formulas or keyframes describe, ``recorded`` whisking from files; both give the
angles of each follicle over time, continuous when the head turns too. ``jobs`` are what engines simulate and return.
"""
