"""Published methods for catches: a quadrotor catches thrown balls with a net."""
