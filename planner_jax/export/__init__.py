"""Plans in the file formats of controllers: setpoints and polynomials."""
