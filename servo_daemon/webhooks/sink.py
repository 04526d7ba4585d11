"""Everything one `[[webhook]]` asks for: a thread that collects events and sends them, one after the other."""

from __future__ import annotations

import hashlib
import logging
import random
import time
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from servo_daemon.background import Background
from servo_daemon.config.sinks import WebhookConfig
from servo_daemon.disk_queue import DiskQueue
from servo_daemon.errors import ConfigError
from servo_daemon.published.sinks import Followed, HasEvents, SinkState, event_body
from servo_daemon.webhooks.request import AwayError, RefusedError, post, read_secret

log = logging.getLogger(__name__)

#: Events are looked for this often, s.
_EVERY_S: Final = 0.2
#: Between two attempts: doubled each time, up to the second; random between half and all of it.
_RETRY_S: Final = (1.0, 300.0)
#: What waits for a receiver that is away: some ten thousand events.
_MOST_BYTES: Final = 5e6


class WebhookSink(Background):
    """One receiver; events up to the stop are kept for the next run if they cannot be sent.

    Args:
        name: among the sinks.
        state_dir: where is kept what cannot be sent; None: in memory.

    Raises:
        ConfigError: the secret cannot be read.
    """

    def __init__(self, config: WebhookConfig, name: str, sources: Sequence[HasEvents], state_dir: Path | None) -> None:
        super().__init__(name)
        if config.secret_file is not None:
            read_secret(config.secret_file)
        self._config, self._name = config, name
        self._drives = Followed(sources)
        file = f"webhook-{hashlib.sha256(config.url.encode()).hexdigest()[:12]}.sqlite"
        self._queue = DiskQueue(None if state_dir is None else state_dir / file, _MOST_BYTES)
        self._connected: bool | None = None
        self._reason: str | None = None
        self._sent = self._refused = self._reconnects = 0
        self._again_at, self._pause = 0.0, _RETRY_S[0]

    @property
    def state(self) -> SinkState:
        queue = self._queue
        return SinkState(
            self._name, self._connected, len(queue), self._sent, queue.dropped + self._refused, self._reconnects,
            self._reason, queue.problem,
        )  # fmt: skip

    def follow(self, sources: Sequence[HasEvents]) -> None:
        """These are the drives from now on."""
        self._drives.wanted = sources

    def stop(self, timeout_s: float) -> None:
        super().stop(timeout_s)
        self._queue.close()

    def _run(self) -> None:
        self._go_round(self._turn, _EVERY_S)

    def _turn(self, _: bool) -> None:
        self._collect()
        while not self._stop.is_set() and time.monotonic() >= self._again_at and self._send_one():
            pass

    def _collect(self) -> None:
        wanted = [(name, event) for name, event in self._drives.take() if self._wants(name, event.kind)]
        self._queue.put([(f"msg_{uuid.uuid4().hex}", name, event_body(name, event)) for name, event in wanted])

    def _wants(self, drive: str, kind: str) -> bool:
        c = self._config
        return (not c.drives or drive in c.drives) and (not c.kinds or kind in c.kinds)

    def _send_one(self) -> bool:
        """The oldest event; whether the next one may follow at once."""
        items = self._queue.head(1)
        if not items:
            return False
        (item,) = items
        try:
            secret = None if self._config.secret_file is None else read_secret(self._config.secret_file)
            post(self._config.url, item.kind, item.body, secret, time.time())
            self._sent += 1
        except RefusedError as error:
            self._refused += 1
            log.warning("%s: %s refuses an event, which is dropped: %s", self._name, self._where, error)
        except (AwayError, ConfigError) as error:
            self._fail(str(error))
            return False
        self._queue.remove(item.number)
        self._succeed()
        return True

    @property
    def _where(self) -> str:
        """Without the path, which may be secret."""
        return urlsplit(self._config.url).hostname or ""

    def _succeed(self) -> None:
        if self._reason is not None:
            self._reconnects += 1
            log.info("%s: %s takes events again", self._name, self._where)
        self._connected, self._reason, self._pause = True, None, _RETRY_S[0]

    def _fail(self, text: str) -> None:
        if self._reason is None:
            log.warning("%s: %s: %s; tried again, and events are kept", self._name, self._where, text)
        self._connected, self._reason = False, text
        self._again_at = time.monotonic() + self._pause * random.uniform(0.5, 1.0)
        self._pause = min(2.0 * self._pause, _RETRY_S[1])
