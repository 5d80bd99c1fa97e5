"""The block sweep: how the arm is driven, and how exactly it has to meet a ball."""
