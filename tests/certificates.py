"""Self-signed certificates, made by openssl."""

from __future__ import annotations

import subprocess
from pathlib import Path


def make_certificate(openssl: str, folder: Path, name: str) -> tuple[Path, Path]:
    """Certificate and private key of `name`, PEM; takes the place of what is there as a whole."""
    files = folder / "tls.crt", folder / "tls.key"
    new = folder / "new.crt", folder / "new.key"
    kind = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2")
    command = (openssl, "req", "-x509", *kind, "-subj", f"/CN={name}", "-out", str(new[0]), "-keyout", str(new[1]))
    subprocess.run(command, check=True, capture_output=True)
    for there, place in zip(new, files, strict=True):
        there.replace(place)
    return files
