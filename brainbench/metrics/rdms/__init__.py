"""Representational dissimilarity matrices: distances, noise precision, comparison, display."""
