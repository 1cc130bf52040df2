"""The error of this package."""


class ExportError(Exception):
    """Why nothing was exported: the file or the option, what was expected and what came."""
