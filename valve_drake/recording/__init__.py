"""The log: what is written (signals, schemas, foxglove, scene, layout), writing it (recorder_system, writer), reading it (reader)."""
