"""Noise settings from recordings of a real sensor."""
