"""The robot as one value, read from its model and one YAML file; and models made from what people have."""
