"""Sound of contacts and drives."""
