"""MuJoCo as a whisker engine: the independent CPU reference."""
