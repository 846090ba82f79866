"""Files, threads, devices, processes and command lines: infrastructure that is independent of the method."""
