"""Files, threads, devices, processes and command lines: what the method itself knows nothing of."""
