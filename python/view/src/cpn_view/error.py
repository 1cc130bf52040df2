"""Error of this package."""


class ViewError(Exception):
    """Failed view; the message names the option, file or field, what was expected and what came."""
