"""Published methods that the planners are compared with, loaded by name only."""
