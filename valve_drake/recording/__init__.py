"""The log.

What is written: signals, schemas, foxglove, scene, robot_frames, layout. Writing it: recorder_system, writer,
container. Reading it: reader.
"""
