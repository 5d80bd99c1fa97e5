"""The sweeps of cars that meet one moving target, or a group of targets one after another."""
