"""A quadrotor catches flying targets in a net, one or several in sequence (paper 000)."""
