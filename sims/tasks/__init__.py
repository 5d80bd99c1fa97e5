"""Simulations of robots that execute and replan hits, catches, interceptions and blocks."""
