"""The one way in for files of users: a path is checked, the file is read within bounds, and its values are checked.

``regular`` (what may be opened, and how failures are told) → ``texts`` (JSON, TOML, YAML), ``tables``, ``hdf5``,
``tensors`` (npz and weights) and ``apart`` (by compiled code). ``sealed`` keeps the entries of the cache with their
hashes, some named by a stamp of the installed code.
"""
