"""A drive on a serial port: `wire_decoder` or `wire_text` for the bytes, `listener` for the port."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field, model_validator

from drivers.base import DriveInfo, OnboardEstimates
from drivers.options import STRICT, checked
from drivers.serial.decoder import BinaryDecoder
from drivers.serial.listener import SerialListener
from drivers.serial.text import TextDecoder
from drivers.serial.text_format import TextFormat, named_format
from drivers.serial.wire import Description, Quantity

#: Channels that the wire has as something else.
_COUNTED = {"position_counts": "position_rad"}

_TEXT_ONLY = ("columns", "counts_per_rev", "counts_modulus", "sample_period_s", "voltage_lsb_V", "current_lsb_A")


class SerialOptions(BaseModel):
    """`[drive.options]` of `driver = "serial"`.

    The text wire tells little of the drive, so its options do: `columns` where lines are not `t_us,mV,mA,counts` and no
    header line says so, `counts_per_rev` (needed where counts are sent), `counts_modulus` if the counter is not one of
    32 bits, `sample_period_s` if sampling is regular, and the resolutions of the converters.
    """

    model_config = STRICT

    port: str = Field(min_length=1)
    baudrate: int = Field(921600, gt=0)
    wire: Literal["binary", "text"] = "binary"
    drive_id: int | None = Field(None, ge=0, le=255)
    columns: str | None = None
    counts_per_rev: float | None = None
    counts_modulus: int | None = Field(None, ge=2, le=1 << 32)
    sample_period_s: float | None = Field(None, gt=0)
    voltage_lsb_V: float | None = Field(None, gt=0)
    current_lsb_A: float | None = Field(None, gt=0)

    @model_validator(mode="after")
    def _options_suit_the_wire(self) -> SerialOptions:
        if self.wire == "text":
            told = self.format
            if self.columns is not None and told is None:
                raise ValueError(f"'columns': {self.columns!r} names no sample, as \"t_us,mV,mA,counts\" does")
            counted = told is None or told.index("position_counts") is not None
            if self.counts_per_rev == 0.0 or (counted and self.counts_per_rev is None):
                raise ValueError("'counts_per_rev' is needed with wire = \"text\" and is not 0")
            if told is not None and told.time is None and self.sample_period_s is None:
                raise ValueError("'columns' names no time: 'sample_period_s' is needed")
            if self.drive_id is not None:
                raise ValueError("'drive_id' is of no use with wire = \"text\": its lines carry none")
        for key in _TEXT_ONLY:
            if self.wire == "binary" and getattr(self, key) is not None:
                raise ValueError(f"'{key}' is for wire = \"text\" only: on the binary wire the device tells it")
        return self

    @property
    def format(self) -> TextFormat | None:
        """The lines' columns, where they are told."""
        return None if self.columns is None else named_format(self.columns)


class SerialDriver(SerialListener):
    """A drive on a serial port. Options: see `SerialOptions`.

    Over `close` and `open` the time goes on if the same device still answers; otherwise the first sample is flagged
    `Quality.TIME_RESTART`.
    """

    kind = "serial"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        settings = self._settings = checked(SerialOptions, name, options)
        text = settings.wire == "text"
        super().__init__(name, options, port=settings.port, baudrate=settings.baudrate, keep=text)
        self._decoder = self._make_decoder()
        self._info_is_of: Description | None = None  # as it was when `info` was last asked for, with every turn
        self._info = DriveInfo(identity="")

    def _make_decoder(self) -> BinaryDecoder | TextDecoder:
        settings = self._settings
        if settings.wire == "binary":
            return BinaryDecoder(settings.drive_id, self.counters)
        return TextDecoder(
            settings.counts_per_rev,
            sample_period_s=settings.sample_period_s,
            counts_modulus=settings.counts_modulus or 1 << 32,
            columns=settings.format,
            counters=self.counters,
        )

    @property
    def info(self) -> DriveInfo:
        """On the binary wire known once the first description has come; until then the identity is empty."""
        settings = self._settings
        if isinstance(self._decoder, BinaryDecoder):
            described = self._decoder.description
            if described is not self._info_is_of:
                self._info = DriveInfo(identity="") if described is None else info_of(described, settings.port)
                self._info_is_of = described
            return self._info
        counted = "position_counts" in self._decoder.format.channels
        return DriveInfo(
            identity=f"serial:{settings.port}",
            sample_period_s=settings.sample_period_s,
            counts_per_rev=abs(settings.counts_per_rev or 0.0) or None if counted else None,
            current_lsb_A=settings.current_lsb_A or 1e-3,
            voltage_lsb_V=settings.voltage_lsb_V or 1e-3,
            channels=tuple(dict.fromkeys(_COUNTED.get(c, c) for c in self._decoder.format.channels)),
        )

    @property
    def onboard(self) -> OnboardEstimates | None:
        return self._decoder.onboard if isinstance(self._decoder, BinaryDecoder) else None

    @property
    def unread(self) -> str | None:
        decoder = self._decoder
        if isinstance(decoder, BinaryDecoder):
            return None
        if not decoder.unread:
            return None
        names, line = ",".join(decoder.format.names), decoder.unread.decode("utf-8", "replace")
        if not decoder.usable:
            lacks = "counts_per_rev" if decoder.format.time is not None else "a time (t_us), or sample_period_s"
            return f"its lines hold {names}, which needs {lacks}: {line!r}"
        return f"a line that is not {names}: {line!r}; a header line or the option columns says what it is"

    @property
    def _stream(self) -> BinaryDecoder | TextDecoder:
        return self._decoder

    def _hear(self, data: bytes) -> None:
        if isinstance(self._decoder, TextDecoder):
            self._decoder.hear(data)


def info_of(description: Description, port: str) -> DriveInfo:
    """What a description tells. The identity is serial number and drive id, or the port where there is no number."""

    def lsb(quantity: Quantity) -> float | None:
        channel = description.channel(quantity)
        return None if channel is None else abs(channel.scale)

    return DriveInfo(
        identity=f"{description.identity or f'serial:{port}'}#{description.drive_id}",
        sample_period_s=description.sample_period_ns / 1e9 or None,
        counts_per_rev=lsb(Quantity.POSITION),
        current_lsb_A=lsb(Quantity.CURRENT),
        voltage_lsb_V=lsb(Quantity.VOLTAGE),
        channels=description.channel_names,
    )
