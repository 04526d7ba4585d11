"""`servo-daemon token`: who may use the API of a daemon that listens on a network."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from servo_daemon.api.access.tokens import NAME, SCOPES, new_token, read_tokens
from servo_daemon.errors import BadInputError
from servo_daemon.files import AtomicFile

HELP = "tokens for the API: a new one, those there are, one taken back"
EXAMPLE = """  servo-daemon token new grafana --scope read --file /etc/servo-daemon/tokens
  servo-daemon token list --file /etc/servo-daemon/tokens
  servo-daemon token revoke grafana --file /etc/servo-daemon/tokens"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("new", "list", "revoke"))
    parser.add_argument("name", nargs="?", help="of the token: who has it")
    parser.add_argument("--scope", choices=SCOPES, default="read", help="what it allows (default: read)")
    parser.add_argument("--file", type=Path, required=True, help="[api] tokens_file of the daemon")


def run(arguments: argparse.Namespace) -> int:
    """A new token is printed once, to stdout, and only its hash is kept."""
    path, name = arguments.file, arguments.name
    tokens = {t.name: t for t in read_tokens(path)} if path.exists() else {}
    if arguments.action == "list":
        for token in tokens.values():
            print(f"{token.name} {token.scope}")
        return 0
    if name is None or not NAME.fullmatch(name):
        raise BadInputError(f"{name!r} is no name for a token: letters, digits, '_', '-', '.', '@'")
    if arguments.action == "revoke":
        if tokens.pop(name, None) is None:
            raise BadInputError(f"{path}: no token of the name {name}; there are {', '.join(tokens) or 'none'}")
        _write(path, "".join(t.line for t in tokens.values()))
        return 0
    if name in tokens:
        raise BadInputError(f"{path}: there is a token of the name {name} already: revoke it first")
    tokens[name], secret = new_token(name, arguments.scope)
    _write(path, "".join(t.line for t in tokens.values()))
    print(secret)
    return 0


def _write(path: Path, text: str) -> None:
    """Only the owner may write; owner, group and mode of a file that is there stay."""
    file = AtomicFile(path)
    try:
        if path.exists() and hasattr(os, "fchown"):
            old = path.stat()
            os.fchown(file.file.fileno(), old.st_uid, old.st_gid)
            os.fchmod(file.file.fileno(), old.st_mode & 0o755)
        elif hasattr(os, "fchmod"):
            os.fchmod(file.file.fileno(), 0o640)
        file.write(text.encode())
        file.commit()
    except OSError as error:
        raise BadInputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        file.discard()
