"""Types of options, and their defaults in help texts."""

from typing import Annotated

import tyro


def _hint(default: str) -> str:
    return f"(default: {default})" if default.strip("'") not in ("", "None") else ""


Text = Annotated[str, tyro.conf.arg(help_behavior_hint=_hint)]
"""Text; empty if not given, as are the others."""
Address = Annotated[str, tyro.conf.arg(metavar="ADDRESS", help_behavior_hint=_hint)]
File = Annotated[str, tyro.conf.arg(metavar="FILE", help_behavior_hint=_hint)]
Files = Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="")]
Number = Annotated[int | None, tyro.conf.arg(help_behavior_hint=_hint)]
