"""The one error that bad input raises, and the one warning."""


class SceneError(ValueError):
    """A scene that cannot be simulated; the message says where, what was found, and what would be right."""


class SceneWarning(UserWarning):
    """What was left out of a file, or converted, so that the scene could be simulated."""
