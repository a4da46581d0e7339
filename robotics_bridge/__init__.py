"""The robotics bridge: touch of robot hands, simulated in thousands of environments at once.

``physics`` fills one batched state (C MuJoCo on processors, MuJoCo Warp on a GPU), ``sensors`` reads it, ``hands`` says
where the sensors sit. Imports ``brainbench.models`` and the floor, never the reverse.
"""
