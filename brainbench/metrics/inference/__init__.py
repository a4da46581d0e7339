"""What can be concluded: permutation tests, bootstrap, intervals, multiple comparisons, power."""
