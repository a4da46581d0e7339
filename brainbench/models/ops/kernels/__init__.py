"""GPU kernels of recurrent convolutions, written in Triton."""
