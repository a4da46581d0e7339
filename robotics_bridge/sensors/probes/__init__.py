"""Probes of distance, depth and contact: ``placement`` says where probes of any sensor sit, ``sensors`` holds the
configurations and launches the ``kernels``, which ask the solids that a link meets.
"""
