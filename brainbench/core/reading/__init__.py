"""The one way in for files of users: a path is checked, the file is read within bounds, and its values are checked.

``regular`` (what may be opened, and how failures are told) → ``texts`` (JSON, TOML, YAML), ``tables``, ``hdf5``,
``archives`` (npz) and ``tensors`` (safetensors, PyTorch), or a process ``apart`` for compiled readers → ``ranges`` (finite, within bounds). ``sealed`` keeps the
entries of the cache with their hashes, some of them named by a stamp of the installed code.
"""
