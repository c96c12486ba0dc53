"""Implicit Euler: external loads."""
