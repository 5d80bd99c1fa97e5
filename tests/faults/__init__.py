"""Faults on purpose: kills, twins, damaged files, full disks and signals. `make test-faults` tries
them in numbers; the modules test_*.py hold a short form of each for the default suite."""
