"""Temperature of a link in cells."""
