"""The stages that move the robot: each a pair, x.py the mathematics and x_system.py the block. They never import each other."""
