"""The README as a package index shows it, where links into a repository lead nowhere.

With PDIPC_SOURCE, the address that files of this version have (https://host/owner/pdipc/blob/v0.1.0), links and pictures are absolute; without
it pictures are left out, and what links say stays as text.
"""

import os
import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|#|mailto:)([^)\s]+)\)")


def readme(text: str, source: str | None) -> str:
    """The text with its relative links made absolute, or taken out where `source` is None."""

    def absolute(link: re.Match) -> str:
        picture, said, path = link.groups()
        if source is None:
            return "" if picture else said
        raw = "?raw=true" if picture else ""
        return f"{picture}[{said}]({source.rstrip('/')}/{path}{raw})"

    return LINK.sub(absolute, text)


class CustomMetadataHook(MetadataHookInterface):
    """Called by hatchling when the package is built or installed."""

    def update(self, metadata: dict) -> None:
        """Puts the README in."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": readme(text, os.environ.get("PDIPC_SOURCE"))}
