"""Optional: benchmarks, one file that others score on. Nothing else imports it; without it ``--benchmark`` is gone.

``definition`` is what the file states, ``files`` finds, unpacks and packs it and holds every byte against its hash,
``making`` makes and checks one, ``opening`` hands it to a score, ``commands`` holds ``brainbench benchmark``.
"""
