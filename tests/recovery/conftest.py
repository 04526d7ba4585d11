"""What the recovery tests need: a C compiler for their independent generator."""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn

import pytest

from tests.recovery.generator import find_compiler


@pytest.fixture
def generator_built(missing: Callable[[str], NoReturn]) -> None:
    """Skips, with the reason, where the generator cannot be compiled."""
    if find_compiler() is None:
        missing("a C compiler (cc, gcc, clang or $CC): the independent generator cannot be built")
