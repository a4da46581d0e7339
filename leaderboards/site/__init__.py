"""The static site of a leaderboard: pages, tables, downloads, and a local server."""
