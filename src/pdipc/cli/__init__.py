"""The command line: a module for each group of commands.

Errors are one message. Exit codes: 0 good, 1 failure, 2 usage, or input that cannot be read or simulated.
"""

from pdipc.cli import judging, looking, reproducing, running, scenes, sweeping  # noqa: F401  (each registers its commands)
from pdipc.cli.app import app
from pdipc.cli.app import metres as metres

__all__ = ["app", "metres"]
