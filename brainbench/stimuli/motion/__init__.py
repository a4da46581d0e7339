"""How whiskers, heads and objects move: trajectories, recorded whisking, hinge angles."""
