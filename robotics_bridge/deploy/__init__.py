"""Policies on hands: what a hand offers, the safety of the way to it, the control loop.

``driver`` says what a hand offers and lets only safe and fresh commands pass. ``session`` runs an exported policy: it
reads the hand, makes observations (touch among them), decides, and sends targets. Drivers come from entry points, such
as those of the optional room ``links``.
"""
