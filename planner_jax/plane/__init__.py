"""Obstacles and targets in the plane, and the sets of states that a car can reach."""
