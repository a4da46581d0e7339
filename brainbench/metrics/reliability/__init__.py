"""Reliability of an animal's RDM: ``sessions`` sorts trials and divides by their noise, ``halves`` makes RDMs of parts
of them and leaves unreliable units out, ``subject_rdm`` joins these, ``noise_correction`` uses them."""
