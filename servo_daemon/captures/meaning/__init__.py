"""What a capture's numbers say about what its columns mean: units, signs, counters, kinds of current sensor that give
themselves away. Nothing is changed on a guess: each finding says the line that mends it.
"""

from servo_daemon.captures.meaning.finding import Finding
from servo_daemon.captures.meaning.findings import as_meant, findings, without_unusable
from servo_daemon.captures.meaning.given import excluded_values
from servo_daemon.captures.meaning.restored import SHOWS, Shown, restored_current
from servo_daemon.captures.meaning.signs import (
    no_sign_of_current,
    no_sign_of_speed,
    no_sign_of_voltage,
    shows_no_sign,
    takes_no_power,
    turned_voltage,
)
from servo_daemon.captures.meaning.voltages import closes_as_it_stands, may_be_driven

__all__ = [
    "SHOWS",
    "Finding",
    "Shown",
    "as_meant",
    "closes_as_it_stands",
    "excluded_values",
    "findings",
    "may_be_driven",
    "no_sign_of_current",
    "no_sign_of_speed",
    "no_sign_of_voltage",
    "restored_current",
    "shows_no_sign",
    "takes_no_power",
    "turned_voltage",
    "without_unusable",
]
