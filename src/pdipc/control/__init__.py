"""What changes between steps: commands, and pins that begin and end."""
