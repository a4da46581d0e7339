"""Marker displacement of a soft pad."""
