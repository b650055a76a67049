"""Run folders that somebody has changed, made from a seed, behind right checksums or not."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any


def facts_of(data: bytes) -> dict[str, Any]:
    """What a manifest says of a file."""
    return {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def manifest_text(manifest: Any) -> bytes:
    """A manifest behind its right checksum, if it is an object."""
    body = json.dumps(manifest, indent=1)
    if not isinstance(manifest, dict) or not manifest:
        return body.encode()
    return f'{body[:-2]},\n "sha256": "{hashlib.sha256(body.encode()).hexdigest()}"\n}}'.encode()


def rewritten(path: Path, change: Callable[[Any], Any]) -> None:
    """Change a manifest, as anybody can who knows how its checksum is made."""
    manifest = json.loads(path.read_bytes())
    del manifest["sha256"]
    change(manifest)
    path.write_bytes(manifest_text(manifest))
