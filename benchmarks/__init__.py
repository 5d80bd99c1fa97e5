"""Measurements that anyone can run again: speed, success and cost, side by side."""
