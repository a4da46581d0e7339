"""PyBullet as a whisker engine, compatible with WHISKiT."""
