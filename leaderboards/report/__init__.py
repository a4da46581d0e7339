"""Reports: of one score, and of a board for a paper's supplement."""
