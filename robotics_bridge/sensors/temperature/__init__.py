"""Temperature of a link in cells: ``grid`` holds materials and configuration.

An update turns contacts into conductances, exchanges heat, diffuses it and lets the sensing element follow
(``runtime``).
"""
