"""Optional: power of a planned experiment. Nothing else imports this folder; without it ``brainbench power`` is gone.

``experiments`` simulates experiments, tests each like a score, and estimates how many dimensions representations have;
``commands`` holds the command.
"""
