"""Projective constraints (Sections 3 and 4.3): one file a kind, each with NAME, CORNERS, rest, functions, kernels."""

from pdipc.constraints.base import ConstraintSet, stiffness_matrix
from pdipc.constraints.projector import KINDS, Projector

__all__ = ["KINDS", "ConstraintSet", "Projector", "stiffness_matrix"]
