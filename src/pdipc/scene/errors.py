"""The one error that bad input raises."""


class SceneError(ValueError):
    """A scene that cannot be simulated; the message says where, what was found, and what would be right."""
