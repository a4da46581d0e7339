"""Reliability of an animal's RDM: ``sessions`` sorts trials, ``whitening`` divides by their noise, ``halves``
makes RDMs of parts of them, ``subject_rdm`` joins these; ``noise_correction`` and ``ceiling`` use it."""
