"""Policies that decide the order and times of catches: Flax networks, trained with Brax's PPO."""
