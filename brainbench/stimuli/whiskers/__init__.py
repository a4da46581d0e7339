"""Whiskers: one rod, arrays of them, the chain of links that engines simulate, naming."""
