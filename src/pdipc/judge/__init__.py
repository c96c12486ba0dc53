"""What judges a simulation and shares no code with it."""
