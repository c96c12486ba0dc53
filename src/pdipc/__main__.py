"""`python -m pdipc`."""

from pdipc.cli.commands import app

app()
