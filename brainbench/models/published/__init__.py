"""The networks of the published study (Chung et al. 2025): their files to checkpoints of ours, and their readout.

Order of the data: file → names → checkpoint; a network's activations → readout.
"""
