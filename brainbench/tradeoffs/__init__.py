"""Optional: accuracy against cost, measured. Nothing else imports it; without it ``brainbench tradeoff`` is gone.

``study`` is the one mechanism: settings, a table that goes on where it stopped, and its front.
``whiskers`` and ``sensors`` say what is measured, ``commands`` holds the commands. The tables that ship, and
``Fidelity.auto`` which reads them, stand with whiskers and sensors.
"""
