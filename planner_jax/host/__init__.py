"""Services of the machine: signals, files, memory, processors, threads and the compile cache."""
