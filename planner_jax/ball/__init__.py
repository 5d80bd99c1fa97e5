"""The ball: flight, impact, prediction and estimation."""
