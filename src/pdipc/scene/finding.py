"""What a check finds."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """Something that must be put right. where: bodies or keys. found: what is wrong. right: what would be right, if that is not
    in `found`. readable: False for what could not be read, or names what is not there; True for what was read and cannot be simulated.
    """

    where: str
    found: str
    right: str = ""
    readable: bool = True

    def __str__(self) -> str:
        return f"{self.where}: {self.found}" + (f"; {self.right}" if self.right else "")
