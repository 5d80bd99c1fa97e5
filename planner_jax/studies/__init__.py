"""Experiments that extend a task, such as a simulated camera; not part of the public interface."""
