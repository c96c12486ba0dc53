"""`python -m pdipc`."""

from pdipc.cli import app

app()
