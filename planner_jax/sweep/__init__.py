"""Sweeps: draw many seeded cases of a task, plan and judge them, and store all in one folder."""
