"""Published methods for interceptions (a car meets a moving target), with searches and splines."""
