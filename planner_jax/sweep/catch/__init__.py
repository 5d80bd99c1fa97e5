"""The sweep of catches: a quadrotor catches flying targets with a net."""
