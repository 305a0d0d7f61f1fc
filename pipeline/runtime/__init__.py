"""What the machine offers: devices, memory, threads, processes, compiled kernels, checkpoints and timing."""
