"""Traced shapes of whiskers: what trackers write, as data sets in SI units, and their faults."""
