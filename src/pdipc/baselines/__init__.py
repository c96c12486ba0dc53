"""The methods that pdipc is measured against: IPC and plain projective dynamics, written apart from it on NumPy and SciPy.

They share no code with the simulator, so that they can serve as its reference. Clear before fast, but vectorised: an Armadillo
of 55,000 tets takes seconds to a few minutes a step.
"""
