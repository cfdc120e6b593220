"""``python -m sidelong_service`` is the command ``sidelong``."""

from sidelong_service.cli import app

app()
