"""Policies on hands: drivers, safety, the control loop, recorded episodes.

``driver`` says what a hand must offer, ``udp`` speaks to one over a socket, ``sim_hand`` is a simulated XHand1 behind
that socket, ``touch`` turns real readings into the observation of the simulator, ``shadow`` simulates the rest,
``safety`` and ``monitor`` watch, ``controller`` runs the loop, ``session`` builds it from an exported policy,
``lerobot`` writes episodes for robot-learning tools.
"""
