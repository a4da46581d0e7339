"""Checks of recordings, worst finding first: clock, labels, spikes and tables."""
