"""Optional: power of a planned experiment. Nothing else imports this folder; without it ``brainbench power`` is gone.

``experiments`` simulates experiments and tests each like a score, ``dimensions`` estimates how many dimensions
representations have, and ``commands`` holds the command.
"""
