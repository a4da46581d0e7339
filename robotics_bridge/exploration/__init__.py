"""Hands that explore objects: recorded touch that any encoder can be scored or probed on.

``procedures`` are the movements (Lederman & Klatzky 1987), ``record`` moves objects against a hand and keeps what its
taxels feel, as the encoder's input and as a stimulus set.
"""
