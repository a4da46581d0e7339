"""Representational dissimilarity matrices (RDMs): ``dissimilarity`` makes one of patterns, with ``noise`` taken out;
``comparison`` compares them, ``pairs`` orders their entries and names their stimuli.
"""
