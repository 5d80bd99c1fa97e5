"""The sweep of hits: plan and judge many cases of a quadrotor that returns a served ball."""
