"""Which mode the robot is in, and the only block that writes to it."""
