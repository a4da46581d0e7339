"""Parts of writing: ``temporaries`` (names that tell which process writes, and the sweeping of what killed ones left) →
``locks`` (one process at a time in a folder). :mod:`brainbench.core.files` writes by them. ``tensors``
writes safetensors files, ``private`` what nobody else may read.
"""
