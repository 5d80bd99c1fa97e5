"""Finished experiments, which are not part of the public interface."""
