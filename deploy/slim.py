"""Leaves out of this interpreter's site-packages what CasADi's wheel brings and no Python program uses.

That is what C++ programs are built with, and copies: a wheel has no links, so each shared library is in it under two or
three names. They become hard links to one file. Everything works as before, the optional solvers too; again: no change.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sysconfig
from pathlib import Path

#: Of the package's folder: headers, files for CMake and pkg-config, static libraries and libtool's notes about them.
FOR_C_PLUS_PLUS = ("include", "cmake", "pkgconfig", "*.a", "*.la")


def slim(package: Path) -> None:
    """The folder of an installed package without what is for C++, and without copies of its libraries."""
    for pattern in FOR_C_PLUS_PLUS:
        for path in package.glob(pattern):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
    first: dict[bytes, Path] = {}
    for path in sorted(package.glob("lib*")):
        if path.is_file():
            link_to(first.setdefault(hashlib.sha256(path.read_bytes()).digest(), path), path)


def link_to(kept: Path, path: Path) -> None:
    """`path`, a copy of `kept`, becomes another name of the same file; stays a copy where there are no hard links."""
    if path.samefile(kept):
        return
    link = path.with_name(path.name + ".link")
    try:
        os.link(kept, link)
    except OSError:
        return
    link.replace(path)


if __name__ == "__main__":
    slim(Path(sysconfig.get_path("platlib")) / "casadi")
