"""`servo-daemon config`: a configuration as the daemon reads it, and the schema of its files."""

from __future__ import annotations

import argparse
import json

from servo_daemon.commands.shared import common
from servo_daemon.config import load_config
from servo_daemon.config.shown import shown, toml

HELP = "show a configuration merged with its conf.d, secrets hidden; print the JSON schema of its files"
EXAMPLE = """  servo-daemon config show --config /etc/servo-daemon/servo-daemon.toml
  servo-daemon config schema  # > servo-daemon.schema.json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("show", "schema"))
    common.add_config(parser, drive=False)
    parser.add_argument("--defaults", action="store_true", help="show: what is not written as well")
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """`show` prints TOML that could take the place of the files, but for the secrets."""
    if arguments.action == "schema":
        from drivers.registry import available
        from servo_daemon.config.schema import json_schema

        print(json.dumps(json_schema(available()), indent=1, ensure_ascii=False))
        return 0
    document = shown(load_config(arguments.config), defaults=arguments.defaults)
    if arguments.json:
        common.print_json(document)
    else:
        print(toml(document), end="")
    return 0
