"""Plans for controllers: setpoints and polynomials in the formats that flight stacks read."""
