"""Representational dissimilarity matrices (RDMs): ``dissimilarity`` makes one of patterns, without trial noise;
``comparison`` compares them, ``pairs`` orders their entries and names their stimuli.
"""
