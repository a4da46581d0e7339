"""Hands at the end of a link: an authenticated UDP connection, a simulated hand with faults, sessions as data sets.

``udp`` authenticates datagrams and has both ends of the connection; ``simulated_hand`` is a hand in a process of its
own, and touch simulated beside one; ``replay`` writes what was recorded as a LeRobot data set, and replays such logs.
An optional room: ``robotics_bridge.deploy`` finds it by entry points and works without it.
"""
