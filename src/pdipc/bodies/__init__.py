"""Each kind of body's part of a model: its constraints and its masses."""
