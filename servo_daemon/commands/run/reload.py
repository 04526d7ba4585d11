"""The configuration read again while the daemon runs: all of what can change does, or nothing where a file is wrong."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from servo_daemon.commands.shared.exposure import (
    ServedCertificate,
    certificate_files,
    check_exposure,
    known_tokens,
)
from servo_daemon.config import ApiConfig, Config
from servo_daemon.config.changes import changes
from servo_daemon.errors import ServoDaemonError

if TYPE_CHECKING:
    from servo_daemon.api.access.permission import Access
    from servo_daemon.daemon.daemon import Daemon

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Files:
    """Where the configuration comes from.

    Attributes:
        read: it as it is now.
        log_level: sets that of a configuration.
    """

    read: Callable[[], Config]
    log_level: Callable[[Config], None]


class Reload:
    """Reads the configuration again and brings the daemon to it.

    Args:
        daemon: which has the configuration that is at work.
        files: what it is read from.
        address: on which the API listens.
        access: the API's.
        certificate: its server's; None: no TLS.
    """

    def __init__(
        self,
        daemon: Daemon,
        files: Files,
        address: str,
        access: Access,
        certificate: ServedCertificate | None,
    ) -> None:
        self._daemon, self._files, self._address = daemon, files, address
        self._access, self._certificate = access, certificate

    async def follow(self, asked: asyncio.Event) -> None:
        """Do it each time it is asked for, one after the other."""
        while True:
            await asked.wait()
            asked.clear()
            await self.once()

    async def once(self) -> None:
        """Never raises: what is wrong is told in the log, and everything stays as it was."""
        loop = asyncio.get_running_loop()
        done: asyncio.Future[bool] = loop.create_future()

        def tell(went_over: bool) -> None:
            if not done.done():
                done.set_result(went_over)

        def work() -> None:
            went_over = self._drives()
            with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
                loop.call_soon_threadsafe(tell, went_over)

        # A thread of its own that nobody waits for at a stop: drives that go work off what has come.
        self._daemon.begin_reload()
        try:
            threading.Thread(target=work, name="reload", daemon=True).start()
            if await done:
                self._who_may_ask(self._daemon.config.api)
        finally:
            self._daemon.end_reload()

    def _drives(self) -> bool:
        """Whether the daemon has gone over to what the files say."""
        try:
            config = self._files.read()
            check_exposure(self._address, config.api)
            changed = changes(self._daemon.config, config)
            self._daemon.follow(config, changed)
        except ServoDaemonError as error:
            log.error("reload refused, the configuration stays as it was: %s", error)
            return False
        except Exception:  # an error in the program must not end the daemon
            log.exception("reload failed")
            return False
        for change in changed:
            log.log(logging.WARNING if change.how == "restart" else logging.INFO, "reload: %s", change.text)
        if not changed:
            log.info("reload: the configuration is as it was")
        self._files.log_level(config)
        return True

    def _who_may_ask(self, api: ApiConfig) -> None:
        """Tokens, names and certificate, whose files may be others under the same name."""
        try:
            tokens, files = known_tokens(api), certificate_files(api)
        except ServoDaemonError as error:  # changed since they were checked
            log.error("reload: %s", error)
            return
        if tokens is not None and not tokens.same_as(self._access.tokens):
            log.info("reload: %d tokens", tokens.number)
        self._access.tokens, self._access.open_metrics = tokens, api.metrics == "open"
        self._access.hosts = api.allowed_hosts
        if self._certificate is not None and files is not None:
            self._certificate.look(files)
