"""Motion of whiskers, heads and objects.

``trajectories`` holds motions that formulas or keyframes describe, ``recorded`` whisking from files; both give the
angles of each follicle over time, which ``hinge_angles`` keeps continuous when the head turns.
"""
