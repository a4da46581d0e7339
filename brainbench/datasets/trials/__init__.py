"""From sessions to counted trials: conditions, selection, windows, counts, and blocks per session."""
