"""Optional: benchmarks, one file that others score on. Nothing else imports it; without it ``--benchmark`` is gone.

``opening`` says what the file states, makes one of a score's options, finds, unpacks and packs it, holds every byte
against its hash, and opens it in place of the options; ``commands`` holds ``brainbench benchmark``.
"""
