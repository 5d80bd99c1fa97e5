"""Export of plans to controllers: files and messages with setpoints or polynomials."""
