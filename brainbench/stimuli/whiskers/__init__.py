"""Whiskers: a tapered curved rod and the chain of links that engines simulate in its place (``whisker``), and arrays of
them on the face of a mouse or rat, with the naming of some of them (``array``).
"""
