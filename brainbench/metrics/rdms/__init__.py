"""Representational dissimilarity matrices (RDMs): ``distances`` between patterns, with ``noise`` taken out, make one
(``dissimilarity``); ``comparison`` compares them, ``pairs`` orders their entries, ``display`` draws one."""
