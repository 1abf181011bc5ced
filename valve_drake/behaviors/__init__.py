"""The stages that move the robot, each a pair: x.py the mathematics, x_system.py the block."""
