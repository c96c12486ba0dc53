"""The barrier of Section 4 and its friction and restitution."""
