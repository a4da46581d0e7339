"""Hands at the end of a link: an authenticated UDP connection, a simulated hand with faults, sessions as data sets.

``frames`` lays out and authenticates datagrams; ``udp`` has both ends of the connection; ``simulated_hand`` is a hand
in a process of its own, and touch simulated beside one; ``episodes`` writes what was recorded as a LeRobot data set.
An optional room: ``robotics_bridge.deploy`` finds it by entry points and works without it.
"""
