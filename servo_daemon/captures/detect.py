"""What kind of file it is, by its first bytes, where a magic number alone does not tell."""

from __future__ import annotations

import numpy as np


def is_asc(line: str) -> bool:
    """Whether a file's first line is that of an ASC log."""
    words = line.strip().lower().split()
    begins = words[:1] == ["date"] or words[:2] in (["base", "hex"], ["base", "dec"])
    return begins and len(words) > 1 and "," not in line


def is_mat4(head: bytes) -> bool:
    """Whether a file begins with the header of a MAT file of version 4, which has no magic number.

    Five 32-bit integers (type MOPT, rows, columns, imaginary part, length of the name with its 0), then the name; see
    MathWorks, "MAT-File Format", chapter "Level 4 MAT-File Format".
    """
    if len(head) < 22:
        return False
    for order in ("<i4", ">i4"):
        kind, rows, columns, imaginary, length = np.frombuffer(head[:20], order).tolist()
        machine, rest = divmod(kind, 1000)
        fits = machine == (0 if order == "<i4" else 1) and rest % 10 in (0, 1, 2) and rest // 10 in range(6)
        if fits and rows >= 0 and columns >= 0 and imaginary in (0, 1) and 2 <= length <= 64:
            name = head[20 : 20 + length - 1]
            return name.isascii() and name.replace(b"_", b"a").isalnum() and not name[:1].isdigit()
    return False


def is_mat(head: bytes) -> bool:
    """Whether a file begins as MAT files do (or, as those of version 7.3, with MATLAB's header before HDF5's)."""
    level5 = len(head) >= 128 and head[126:128] in (b"IM", b"MI")
    return head.startswith(b"\x89HDF\r\n\x1a\n") or (level5 and b"MAT" in head[:16]) or is_mat4(head)
