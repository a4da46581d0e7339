"""The noise model of readings."""
