"""The text of a file: packed or not, whatever its encoding."""

from __future__ import annotations

import codecs
import gzip
import io
from pathlib import Path
from typing import BinaryIO, TextIO, cast

from servo_daemon.captures.capture.bounded import BoundedBytes

#: What a program writes first to say which encoding it is. UTF-32 before UTF-16, whose mark it begins with.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
#: Bytes from which the encoding is told.
_HEAD = 65536
#: UTF-16 of European text without a mark: every other byte is 0.
_NULS = 0.3


def open_text(path: Path, raw: BinaryIO, *, packed: bool) -> tuple[TextIO, str]:
    """The file as bounded text, and its encoding as people call it; empty: UTF-8.

    What is not UTF-8 is taken for Windows-1252, of which every byte is some character.
    """
    inner = cast("BinaryIO", gzip.GzipFile(fileobj=raw, mode="rb")) if packed else raw
    data = BoundedBytes(path, inner)
    head = data.read1(_HEAD)
    data.seek(0)
    encoding = encoding_of(head)
    said = "" if encoding.startswith("utf-8") else {"cp1252": "Windows-1252"}.get(encoding, encoding[:6].upper())
    return io.TextIOWrapper(cast("BinaryIO", data), encoding=encoding, errors="replace"), said


def encoding_of(head: bytes) -> str:
    """The encoding of a text by its first bytes, as Python calls it."""
    for mark, encoding in _MARKS:
        if head.startswith(mark):
            return encoding
    pairs = len(head) // 2
    if pairs and len(head) >= 4:
        even, odd = head[0 : 2 * pairs : 2].count(0) / pairs, head[1 : 2 * pairs : 2].count(0) / pairs
        if odd > _NULS and not even:
            return "utf-16-le"
        if even > _NULS and not odd:
            return "utf-16-be"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head, final=False)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"
