"""Good inputs made bad: bytes changed, cut, doubled, joined and replaced by what breaks programs."""

from __future__ import annotations

from random import Random

#: Numbers and signs that programs stumble over, as text.
TOKENS = (
    "0", "-1", "1e400", "-1e308", "nan", "inf", "1e-320", "9" * 30, "0x7f", "1_0", "", " ", '"', "'", "\\", "\x00", "ü",
    "\ud7ff", "[", "]", "{", "}", "[" * 500, '{"a":' * 300, "(" * 200, "-" * 300, "=", ",", ";", ":", "\n", "\r\n", "#",
    "true", "null", "2026-01-01", "1979-05-27T07:32:00Z", "../x", "%s", "*" * 64, "1/0", "()", "é" * 40,
)  # fmt: skip
_BLOBS = (bytes(8), b"\xff" * 8, b"\x00", b"\x80" * 4, b"\x7f\xff\xff\xff", b"\r", b"\n", b"\x00\x00\x80\x7f")


def spoilt_bytes(random: Random, good: bytes) -> bytes:
    """At most four changes; one time in eight noise alone."""
    if random.randrange(8) == 0:
        return random.randbytes(random.randrange(80))
    data = bytearray(good)
    for _ in range(random.randrange(1, 5)):
        at = random.randrange(len(data) + 1)
        match random.randrange(6):
            case 0:
                data[at : at + 1] = random.randbytes(1)
            case 1:
                del data[at : at + random.randrange(1, 9)]
            case 2:
                data[at:at] = data[: random.randrange(1, 17)]
            case 3:
                data[at:at] = random.choice(_BLOBS)
            case 4:
                data = data[:at]
            case _ if at < len(data):
                data[at] ^= 1 << random.randrange(8)
            case _:
                pass
    return bytes(data)


def spoilt_text(random: Random, good: str) -> str:
    """As above by characters, and words in the place of words."""
    text = good
    for _ in range(random.randrange(1, 4)):
        at = random.randrange(len(text) + 1)
        until = min(len(text), at + random.randrange(12))
        match random.randrange(4):
            case 0:
                text = text[:at] + random.choice(TOKENS) + text[until:]
            case 1:
                text = text[:at] + text[until:]
            case 2:
                text = text[:at] + text[random.randrange(len(text) + 1) :][:20] + text[at:]
            case _:
                text = text[:at] + chr(random.choice((random.randrange(128), random.randrange(0xD7FF)))) + text[at:]
    return text
