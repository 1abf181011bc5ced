"""The valve as one value, and its model in Drake."""
