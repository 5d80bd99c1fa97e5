"""The tasks hit, catch, intercept and block as simulated flights, for the closed loop and runs."""
