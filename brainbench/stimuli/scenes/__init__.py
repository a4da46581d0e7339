"""Scenes: an array, its motion, objects and frames; their files and the shipped recipes."""
