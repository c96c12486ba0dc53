"""The command line."""

from pdipc.cli.commands import app, metres

__all__ = ["app", "metres"]
