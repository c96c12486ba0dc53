"""Sections 6 and 7.2: distances, culling, continuous collision detection, truncation."""
