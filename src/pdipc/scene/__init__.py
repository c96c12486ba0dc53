"""Scenes: what a simulation starts from, read from TOML or built in Python, checked, and turned into arrays."""
