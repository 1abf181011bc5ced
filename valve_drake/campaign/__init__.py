"""Campaigns: many runs of a scenario, each with its own seed, and what may be said of them."""
