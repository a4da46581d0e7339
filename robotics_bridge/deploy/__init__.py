"""Policies on hands: drivers, safety, the control loop, recorded episodes.

``driver`` says what a hand offers, ``udp`` speaks to one over a socket, ``simulated_hand`` stands behind that socket.
``session`` builds a ``controller`` from an exported policy; it reads the hand, makes observations (``touch`` of what
the hand measures, ``ShadowTouch`` of what it does not), checks ``safety`` and ``timing``, and sends targets.
``episodes`` are written for LeRobot.
"""
