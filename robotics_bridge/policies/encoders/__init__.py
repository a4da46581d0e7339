"""Tactile encoders of policies: from taxels to features."""
