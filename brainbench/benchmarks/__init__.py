"""Optional: benchmarks, one file that others score on. Nothing else imports it; without it ``--benchmark`` is gone.

``files`` says what the file states, finds, unpacks and packs it and holds every byte against its hash, ``opening``
makes one of a score's options and opens it in their place, ``commands`` holds ``brainbench benchmark``.
"""
