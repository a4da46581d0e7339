"""Training data: sharded whisker sweeps, their memory, and whether their classes can be told apart."""
