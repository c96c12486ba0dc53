"""The contact of the paper as printed: Eq. (6) and its tests."""
