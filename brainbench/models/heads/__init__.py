"""Heads of an encoder: decoders to class scores, and those of the self-supervised objectives."""
