"""Experiments that answered a question and are not part of the public interface."""
