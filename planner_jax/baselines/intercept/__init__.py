"""Published methods for interceptions, and the searches and splines they need."""
