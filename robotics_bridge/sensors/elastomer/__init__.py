"""Marker displacement of a soft pad: ``taxel`` holds the configuration, ``runtime`` the order of the kernels.

Indentation is spread over the grid (``dilation``), points that sink in are anchored (``anchors``) and drag the gel
(``shear``), and every marker sums both.
"""
