"""Attenders: features [B, T, F] to features [B, T, W] that look back over the whole sweep."""
