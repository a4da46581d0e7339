"""Figures: ``style`` holds the look that all charts share."""
