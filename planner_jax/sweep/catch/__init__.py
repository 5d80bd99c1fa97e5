"""The sweep of catches: plan and judge many cases of a quadrotor that catches with a net."""
