"""Results that a benchmark keeps while it runs, so that it can be stopped and go on: as JSON, beside its table."""

import json
from pathlib import Path
from typing import Any

from bbr_layer import atomic_write


def kept_results(table: Path) -> dict[str, Any]:
    """What an earlier run kept for the table of this name."""
    path = _beside(table)
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def keep(results: dict[str, Any], text: str, table: Path) -> None:
    """Write the results, then the table's text; each whole or not at all."""
    path = _beside(table)
    path.parent.mkdir(parents=True, exist_ok=True)
    for there, content in ((path, json.dumps(results, indent=1)), (table, text)):
        with atomic_write(there) as temporary:
            temporary.write_text(content, encoding="utf-8")


def _beside(table: Path) -> Path:
    return Path("out", "benchmark", f"{table.stem}.json")
