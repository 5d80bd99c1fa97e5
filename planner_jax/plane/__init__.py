"""What stands and moves in the plane: obstacles, targets, and where a car can be among them."""
