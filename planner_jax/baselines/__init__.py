"""Published planning methods that this library's planners are compared with (baselines)."""
