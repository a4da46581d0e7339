"""Synthetic recordings whose truth is known: neurons, sessions, files, and the demo recordings."""
