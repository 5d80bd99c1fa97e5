"""What a robot can do: flatness, kinematics and limits."""
