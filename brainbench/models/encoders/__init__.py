"""Encoders: a stimulus [B, T, C, H, W] to features [B, T, F]."""
