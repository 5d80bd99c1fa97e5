"""Published methods for catches."""
