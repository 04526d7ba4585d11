"""A wall clock of its own for one process, which can be set while it runs.

A library that is loaded before the C library's own functions adds an offset to what they say of the wall clock; the
offset is eight bytes of a file that both have mapped. Monotonic clocks are the system's.
"""

from __future__ import annotations

import shutil
import struct
import subprocess
from pathlib import Path

_SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>

static volatile double *offset;
static int (*real_clock)(clockid_t, struct timespec *);

__attribute__((constructor)) static void load(void) {
    real_clock = dlsym(RTLD_NEXT, "clock_gettime");
    const char *path = getenv("SOAK_CLOCK");
    int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    void *at = file < 0 ? MAP_FAILED : mmap(0, sizeof *offset, PROT_READ, MAP_SHARED, file, 0);
    if (at != MAP_FAILED) offset = at;
}

int clock_gettime(clockid_t which, struct timespec *now) {
    if (!real_clock) load();
    int code = real_clock(which, now);
    if (code == 0 && which == CLOCK_REALTIME && offset) now->tv_sec += (time_t)*offset;
    return code;
}

int gettimeofday(struct timeval *now, void *zone) {
    struct timespec t;
    (void)zone;
    int code = clock_gettime(CLOCK_REALTIME, &t);
    now->tv_sec = t.tv_sec;
    now->tv_usec = t.tv_nsec / 1000;
    return code;
}

time_t time(time_t *out) {
    struct timespec t;
    clock_gettime(CLOCK_REALTIME, &t);
    if (out) *out = t.tv_sec;
    return t.tv_sec;
}
"""


class WallClock:
    """Args:
    folder: where the library and the offset are kept.
    """

    def __init__(self, folder: Path) -> None:
        compiler = shutil.which("gcc") or shutil.which("cc")
        self.environment: dict[str, str] = {}
        if compiler is None:
            return
        source, library, self._file = (folder / f"clock{ending}" for ending in (".c", ".so", ".offset"))
        source.write_text(_SOURCE)
        subprocess.run([compiler, "-O1", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
        self._file.write_bytes(bytes(8))
        self.environment = {"LD_PRELOAD": str(library), "SOAK_CLOCK": str(self._file)}

    def __bool__(self) -> bool:
        """Whether it can be set: a C compiler is there."""
        return bool(self.environment)

    def set(self, offset_s: float) -> None:
        """The process' wall clock is so much ahead of ours from now on, whole s."""
        with self._file.open("r+b") as file:
            file.write(struct.pack("d", offset_s))
