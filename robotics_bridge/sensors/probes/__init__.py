"""Probes of distance, depth and contact, and where they sit."""
