"""Named ways to read published data sets: one module per data set, and their registry."""
