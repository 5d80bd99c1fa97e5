"""Published methods for blocks."""
