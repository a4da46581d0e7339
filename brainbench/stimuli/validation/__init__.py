"""Whisker mechanics without an engine, and bench tests that hold engines against it."""
