"""Published methods for hits."""
