"""The one way in for files of users: a path is checked, the file is read within bounds, and its values are checked.

``regular`` (what may be opened, and how failures are told) → ``texts`` (JSON, TOML, tables), ``hdf5`` and ``archives``
(npz, safetensors) → ``ranges`` (finite, within bounds). ``sealed`` keeps the entries of the cache with their hashes.
"""
