"""Reports of records for a paper: :mod:`paper` writes methods, tables, figures and the works to cite."""
