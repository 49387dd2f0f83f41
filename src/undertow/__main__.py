"""``python -m undertow``: the same as the command ``undertow``."""

from undertow.cli import main

main()
