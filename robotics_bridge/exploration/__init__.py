"""Hands that explore objects: recorded touch that any encoder can be scored or probed on.

``record`` moves objects against a hand (Lederman & Klatzky 1987) and keeps what its taxels feel, as the encoder's input
and as a stimulus set. An optional room with its own command.
"""
