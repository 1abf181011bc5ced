"""What the robot does with the valve: the modes."""
