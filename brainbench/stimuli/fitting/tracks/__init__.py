"""Measurements of whiskers: what trackers and force sensors write, as data sets in SI units, and their faults."""
