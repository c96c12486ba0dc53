"""Nonlinear solves inside Algorithm 1."""
