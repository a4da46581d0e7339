"""Temperature of a link in cells: ``grid`` holds the configuration, ``materials`` the numbers of bodies.

An update turns contacts into conductances, exchanges heat, diffuses it and lets the sensing element follow
(``runtime``, ``kernels``).
"""
