"""The robot behind its ports: contract.py is the table that every station is held to."""
