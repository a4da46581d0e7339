"""Reports of records for a paper.

:mod:`paper` writes methods, tables and figures with the works that :mod:`citations` finds.
"""
