"""Error of this package."""


class ExportError(Exception):
    """Failed export; the message names the file or option, what was expected and what came."""
