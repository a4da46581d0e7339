"""Temperature of a link in cells: ``grid`` is the configuration, of ``materials``.

An update turns contacts into conductances, exchanges heat, diffuses it and lets the sensing element follow
(``runtime``).
"""
