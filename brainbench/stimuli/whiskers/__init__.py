"""Whiskers: a tapered curved rod (``whisker``), arrays of them on the face of a mouse or rat (``array``), the naming of
some of them (``selection``), and the chain of links that engines simulate in place of a rod (``chain``).
"""
