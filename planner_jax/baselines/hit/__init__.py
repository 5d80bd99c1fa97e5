"""Published methods for hits: a quadrotor with a racket returns a served ball."""
