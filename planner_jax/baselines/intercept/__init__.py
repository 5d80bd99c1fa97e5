"""Published methods for interceptions by a car, and the searches and splines that they use."""
